//! What each channel is in a recording: its own bytes for replay, and for other people's viewers JSON of small messages, a
//! few a second at most, and images as ROS has them.

use serde_json::Value;
use shared_types::bus::{Envelope, RawMessage};
use shared_types::channel::{Channel, ChannelVisitor, ItemLimit, visit_all};
use shared_types::describe::{message_json, message_schema};

use crate::queue::Priority;

/// How the bytes of a channel's own topic are made; its schema is the JSON schema of the same fields.
pub(crate) const RAW_ENCODING: &str = "vantage";
/// Key of a raw topic's metadata: the schema hash, as on the bus.
pub(crate) const SCHEMA_KEY: &str = "schema";
/// Items beyond this are not told in JSON.
const MOST_ITEMS: usize = 600;

/// A channel, as far as a file must know it.
pub(crate) struct Topic {
    pub name: &'static str,
    /// The schema hash, in hexadecimal.
    pub schema: String,
    pub json_schema: Value,
    /// Least mission time between two messages told in JSON, nanoseconds; `None`: none is.
    pub json_period_ns: Option<u64>,
    pub json_of: fn(&[u8]) -> Option<Value>,
    /// Bytes of a message before its items.
    pub head_bytes: usize,
}

/// Which messages give way to which.
pub(crate) fn priority_of<C: Channel>() -> Priority {
    match (C::SETTINGS.items, C::NAME) {
        (_, "camera/frame" | "simulator/render/reply") => Priority::Stream,
        (ItemLimit::Image | ItemLimit::SmallDepth | ItemLimit::Gaussians, _) => Priority::Bulk,
        _ => Priority::Small,
    }
}

/// How often a channel is told in JSON: what comes with every tick, ten times a second; what only machines read, never.
fn json_period_ns(name: &str) -> Option<u64> {
    match name {
        "clock" | "clock/grant" | "simulator/render/request" | "simulator/render/reply" => None,
        "vehicle/state" | "simulator/truth" | "planner/alive" | "camera/depth" | "camera/frame" => Some(100_000_000),
        _ => Some(0),
    }
}

fn json_of<C: Channel>(bytes: &[u8]) -> Option<Value> {
    let message = RawMessage::<C>::from_bytes(bytes)?;
    let items: &[C::Item] = if message.items.len() <= MOST_ITEMS { &message.items } else { &[] };
    Some(message_json::<C>(&message.envelope, &message.header, items))
}

/// All channels, in the table's order.
pub(crate) fn all() -> Vec<Topic> {
    struct Listing(Vec<Topic>);
    impl ChannelVisitor for Listing {
        fn visit<C: Channel>(&mut self) {
            self.0.push(Topic {
                name: C::NAME,
                schema: format!("{:016x}", C::SCHEMA),
                json_schema: message_schema::<C>(),
                json_period_ns: json_period_ns(C::NAME),
                json_of: json_of::<C>,
                head_bytes: size_of::<Envelope>() + size_of::<C::Header>(),
            });
        }
    }
    let mut listing = Listing(Vec::new());
    visit_all(&mut listing);
    listing.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use shared_types::channel::{FrameChannel, KeyframeChannel, NAMES, SnapshotChannel, VehicleStateChannel};

    #[test]
    fn the_stream_gives_way_to_keyframes_and_these_to_states() {
        assert_eq!(priority_of::<FrameChannel>(), Priority::Stream);
        assert_eq!(priority_of::<KeyframeChannel>(), Priority::Bulk);
        assert_eq!(priority_of::<SnapshotChannel>(), Priority::Bulk);
        assert_eq!(priority_of::<VehicleStateChannel>(), Priority::Small);
    }

    #[test]
    fn every_channel_is_a_topic_in_the_table_s_order() {
        let names: Vec<&str> = all().iter().map(|topic| topic.name).collect();
        assert_eq!(names, NAMES);
    }
}
