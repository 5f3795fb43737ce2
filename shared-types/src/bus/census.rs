//! Who is on a channel, and what it holds in shared memory.

use iceoryx2::prelude::CallbackProgression;
use iceoryx2::service::port_factory::PortFactory as _;
use serde::Serialize;

use super::{Bus, BusError};
use crate::channel::Channel;
use crate::system::SHARED_MEMORY_DIR;

/// What is known of a channel without its messages.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Census {
    /// Its name.
    pub channel: &'static str,
    /// Senders that are connected; a dead one counts until it is cleaned up.
    pub publishers: usize,
    /// Readers that are connected, likewise.
    pub subscribers: usize,
    /// Messages that each reader's queue holds.
    pub queue: usize,
    /// Bytes of shared memory that the senders have reserved.
    pub segment_bytes: u64,
}

impl Bus {
    /// Counts who is on a channel.
    ///
    /// # Errors
    /// When the channel belongs to another version.
    pub fn census<C: Channel>(&self) -> Result<Census, BusError> {
        let factory = self.factory::<C>()?;
        let config = factory.dynamic_config();
        let mut ids = Vec::new();
        config.list_publishers(|publisher| {
            ids.push(publisher.publisher_id.value().to_string());
            CallbackProgression::Continue
        });
        Ok(Census {
            channel: C::NAME,
            publishers: config.number_of_publishers(),
            subscribers: config.number_of_subscribers(),
            queue: C::SETTINGS.queue,
            segment_bytes: segments(&ids),
        })
    }
}

/// Bytes of the segments of these senders; files that vanish meanwhile have none.
fn segments(ids: &[String]) -> u64 {
    let files = std::fs::read_dir(SHARED_MEMORY_DIR).into_iter().flatten().flatten();
    let ours = files.filter(|file| {
        let name = file.file_name();
        let name = name.to_string_lossy();
        name.ends_with(".data") && ids.iter().any(|id| name.contains(id.as_str()))
    });
    ours.filter_map(|file| Some(file.metadata().ok()?.len())).sum()
}
