//! The one thin wrapper over iceoryx2 that every service uses.
//!
//! It fixes what the architecture fixes: settings from the channel table, a schema hash as attribute of each channel,
//! segments reserved at start (a full `/dev/shm` is an error here and not a SIGBUS later), late joiners served by a tick,
//! own signal handling, requests and replies with ids. Nothing else in Vantage names iceoryx2.

mod census;
mod error;
mod message;
mod publisher;
mod raw;
mod request;
mod subscriber;
mod wait;

use std::cell::{Cell, RefCell};
use std::rc::{Rc, Weak};

use iceoryx2::port::update_connections::UpdateConnections as _;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

pub use census::Census;
pub use error::BusError;
pub use message::{Envelope, Message};
pub use publisher::Publisher;
pub use raw::RawMessage;
pub use request::{Client, ReplyAddress, Server};
pub use subscriber::Subscriber;
pub use wait::{Listener, wait};

use crate::channel::{Channel, ItemLimit, MAX_NODES, MAX_PUBLISHERS, MAX_SUBSCRIBERS, RequestChannel, Settings};
use crate::config::Config;
use crate::service::ServiceName;
use crate::system::System;
use message::Framed;

pub(crate) type Ipc = ipc::Service;
type Factory<C> = PortFactory<Ipc, [<C as Channel>::Item], Framed<<C as Channel>::Header>>;
type RawPublisher<C> =
    iceoryx2::port::publisher::Publisher<Ipc, [<C as Channel>::Item], Framed<<C as Channel>::Header>>;

/// What iceoryx2 adds to each chunk: its own header, and alignment.
const CHUNK_BYTES: usize = 64;

/// What large messages may measure, from the configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Bytes of one full-size RGB-D image.
    pub image_bytes: usize,
    /// Bytes of one small depth image.
    pub small_depth_bytes: usize,
    /// Gaussians of the largest model.
    pub gaussians: usize,
}

impl Limits {
    /// The limits of a configuration.
    #[must_use]
    pub fn of(config: &Config) -> Self {
        let pixels = |width: u32, height: u32| width as usize * height as usize;
        Self {
            image_bytes: pixels(config.camera.width_px, config.camera.height_px) * 5,
            small_depth_bytes: pixels(config.camera.depth_width_px, config.camera.depth_height_px) * 2,
            gaussians: config.model.max_gaussians as usize,
        }
    }

    /// Bytes of shared memory that the senders of a channel reserve in a mission.
    #[must_use]
    pub fn reserved_bytes<C: Channel>(&self) -> u64 {
        let Settings { queue, history, chunks, senders, .. } = C::SETTINGS;
        // As iceoryx2 counts: what every reader may keep and hold, the history, and the one being written.
        let worst = MAX_SUBSCRIBERS * (queue.max(history).max(1) + queue + 2) + history + 1;
        let chunk = CHUNK_BYTES + size_of::<Framed<C::Header>>() + self.items(C::SETTINGS.items) * size_of::<C::Item>();
        (senders * chunks.map_or(worst, |chunks| worst.min(chunks)) * chunk) as u64
    }

    fn items(&self, limit: ItemLimit) -> usize {
        match limit {
            ItemLimit::Fixed(items) => items,
            ItemLimit::Image => self.image_bytes,
            ItemLimit::SmallDepth => self.small_depth_bytes,
            ItemLimit::Gaussians => self.gaussians,
        }
        .max(1)
    }
}

/// Something that serves late joiners when asked.
trait Serve {
    fn serve_late_joiners(&self);
}

struct Served<C: Channel>(RawPublisher<C>);

impl<C: Channel> Serve for Served<C> {
    fn serve_late_joiners(&self) {
        if let Err(error) = self.0.update_connections() {
            tracing::debug!(channel = C::NAME, ?error, "could not connect a late joiner");
        }
    }
}

struct Inner {
    node: Node<Ipc>,
    limits: Limits,
    sender: ServiceName,
    incarnation: u64,
    by_tick: bool,
    publishers: RefCell<Vec<Weak<dyn Serve>>>,
    /// Messages that subscribers refused.
    refused: Rc<Cell<u64>>,
}

/// A process's access to all channels of its system. Cheap to clone; stays on the thread that opened it.
#[derive(Clone)]
pub struct Bus(Rc<Inner>);

impl core::fmt::Debug for Bus {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Bus").field("sender", &self.0.sender).field("by_tick", &self.0.by_tick).finish_non_exhaustive()
    }
}

impl Bus {
    /// Joins the domain of a system. `by_tick` is set for members of a lockstep clock: their subscribers show only what was
    /// sent before the present tick.
    ///
    /// # Errors
    /// When the domain cannot be joined: no shared memory, another user's files.
    pub fn open(
        system: &System,
        limits: Limits,
        sender: ServiceName,
        incarnation: u64,
        by_tick: bool,
    ) -> Result<Self, BusError> {
        let path = system.bus_config_path();
        let invalid = |what: &dyn core::fmt::Debug| BusError::Domain { path: path.clone(), cause: format!("{what:?}") };
        let file = FilePath::new(path.as_os_str().as_encoded_bytes()).map_err(|e| invalid(&e))?;
        // Set globally as well as on the node: iceoryx2 cleans up after processes that died before their details were
        // written with the global configuration only.
        let config = iceoryx2::config::Config::setup_global_config_from_file(&file).map_err(|e| invalid(&e))?;
        let own = config.global.prefix.as_bytes() == system.prefix.as_bytes();
        let config =
            if own { config.clone() } else { iceoryx2::config::Config::from_file(&file).map_err(|e| invalid(&e))? };
        let name = NodeName::new(sender.name()).map_err(|e| invalid(&e))?;
        let node = NodeBuilder::new()
            .name(&name)
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Ipc>()
            .map_err(|e| invalid(&e))?;
        Ok(Self(Rc::new(Inner {
            node,
            limits,
            sender,
            incarnation,
            by_tick,
            publishers: RefCell::default(),
            refused: Rc::default(),
        })))
    }

    /// Opens the sending end of a channel.
    ///
    /// # Errors
    /// When the channel belongs to another version, has too many senders, or shared memory is full.
    pub fn publisher<C: Channel>(&self) -> Result<Publisher<C>, BusError> {
        let factory = self.factory::<C>()?;
        let items = self.0.limits.items(C::SETTINGS.items);
        let chunks = C::SETTINGS.chunks;
        let raw = factory
            .publisher_builder()
            .initial_max_slice_len(items)
            .max_loaned_samples(1)
            .allocation_strategy(AllocationStrategy::Static)
            .override_sample_preallocation(move |worst| chunks.map_or(worst, |chunks| worst.min(chunks)))
            .create()
            .map_err(|cause| BusError::Port { channel: C::NAME, cause: format!("{cause:?}") })?;
        reserve::<C>(&raw)?;
        let notifier = if C::SETTINGS.wakes { Some(wait::notifier(&self.0.node, C::NAME)?) } else { None };
        let served = Rc::new(Served::<C>(raw));
        let weak: Weak<dyn Serve> = Rc::downgrade(&(Rc::clone(&served) as Rc<dyn Serve>));
        self.0.publishers.borrow_mut().push(weak);
        Ok(Publisher::new(served, factory, notifier, self.0.sender, self.0.incarnation, items))
    }

    /// Opens the receiving end of a channel.
    ///
    /// # Errors
    /// When the channel belongs to another version or has too many readers.
    pub fn subscriber<C: Channel>(&self) -> Result<Subscriber<C>, BusError> {
        let factory = self.factory::<C>()?;
        let raw = factory
            .subscriber_builder()
            .create()
            .map_err(|cause| BusError::Port { channel: C::NAME, cause: format!("{cause:?}") })?;
        Ok(Subscriber::new(raw, self.0.by_tick && C::SETTINGS.by_tick, Rc::clone(&self.0.refused)))
    }

    /// Opens a client of a request channel.
    ///
    /// # Errors
    /// As [`Self::publisher`] and [`Self::subscriber`].
    pub fn client<R: RequestChannel>(&self) -> Result<Client<R>, BusError> {
        Ok(Client::new(self.publisher()?, self.subscriber()?, self.0.sender))
    }

    /// Opens a server of a request channel.
    ///
    /// # Errors
    /// As [`Self::publisher`] and [`Self::subscriber`].
    pub fn server<R: RequestChannel>(&self) -> Result<Server<R>, BusError> {
        Ok(Server::new(self.subscriber()?, self.publisher()?))
    }

    /// Opens a listener that wakes [`wait`] when something is sent on a channel with `wakes`.
    ///
    /// # Errors
    /// When the event cannot be opened.
    pub fn listener<C: Channel>(&self) -> Result<Listener, BusError> {
        wait::listener(&self.0.node, C::NAME)
    }

    /// Opens a channel without sending or receiving, and keeps it in existence as long as the returned value lives.
    ///
    /// # Errors
    /// When the channel belongs to another version.
    pub fn hold<C: Channel>(&self) -> Result<Box<dyn core::any::Any>, BusError> {
        let event = if C::SETTINGS.wakes { Some(wait::event(&self.0.node, C::NAME)?) } else { None };
        Ok(Box::new((self.factory::<C>()?, event)))
    }

    /// Gives late joiners of all channels that this process sends on what they missed. Called by the service loop.
    pub fn serve_late_joiners(&self) {
        self.0.publishers.borrow_mut().retain(|weak| match weak.upgrade() {
            Some(publisher) => {
                publisher.serve_late_joiners();
                true
            }
            None => false,
        });
    }

    /// Cleans up after processes of this system that died.
    pub fn reap_the_dead(&self) -> u64 {
        self.0.node.try_cleanup_dead_nodes().cleanups
    }

    /// Messages that this process received and refused, on all channels: they could not be what their channel carries.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.0.refused.get()
    }

    /// Who sends on this bus.
    #[must_use]
    pub fn sender(&self) -> ServiceName {
        self.0.sender
    }

    fn factory<C: Channel>(&self) -> Result<Factory<C>, BusError> {
        let failed = |cause: String| BusError::Channel { channel: C::NAME, cause };
        let name: iceoryx2::service::service_name::ServiceName =
            C::NAME.try_into().map_err(|e| failed(format!("{e:?}")))?;
        let schema = format!("{:016x}", C::SCHEMA);
        let key = "schema".try_into().map_err(|e| failed(format!("{e:?}")))?;
        let value = schema.as_str().try_into().map_err(|e| failed(format!("{e:?}")))?;
        let required = AttributeVerifier::new().require(&key, &value).map_err(|e| failed(format!("{e:?}")))?;
        let open = || {
            self.0
                .node
                .service_builder(&name)
                .publish_subscribe::<[C::Item]>()
                .user_header::<Framed<C::Header>>()
                .enable_safe_overflow(true)
                .history_size(C::SETTINGS.history)
                .subscriber_max_buffer_size(C::SETTINGS.queue.max(C::SETTINGS.history).max(1))
                .subscriber_max_borrowed_samples(C::SETTINGS.queue + 2)
                .max_publishers(MAX_PUBLISHERS)
                .max_subscribers(MAX_SUBSCRIBERS)
                .max_nodes(MAX_NODES)
                .open_or_create_with_attributes(&required)
        };
        // Creation by several processes at once, or beside a clean-up, may fail for an instant: it is tried again.
        let mut last = String::new();
        for attempt in 0..20 {
            match open() {
                Ok(factory) => return Ok(factory),
                Err(cause) => {
                    last = format!("{cause:?}");
                    if last.contains("IncompatibleAttributes") || last.contains("IncompatibleTypes") {
                        return Err(BusError::Schema { channel: C::NAME, ours: schema });
                    }
                }
            }
            std::thread::sleep(std::time::Duration::from_millis(10 << (attempt / 4)));
        }
        Err(failed(last))
    }
}

/// Reserves a publisher's segment, so that a full `/dev/shm` is an error now and not a SIGBUS at the first write.
fn reserve<C: Channel>(raw: &RawPublisher<C>) -> Result<(), BusError> {
    let id = raw.id().value().to_string();
    let entries = std::fs::read_dir(crate::system::SHARED_MEMORY_DIR).map_err(|source| BusError::Reserve {
        channel: C::NAME,
        bytes: 0,
        source,
    })?;
    for entry in entries.flatten() {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if !(name.contains(&id) && name.ends_with(".data")) {
            continue;
        }
        let reserved = |bytes: u64, source: std::io::Error| BusError::Reserve { channel: C::NAME, bytes, source };
        let file = std::fs::OpenOptions::new().read(true).write(true).open(entry.path()).map_err(|e| reserved(0, e))?;
        let bytes = file.metadata().map_err(|e| reserved(0, e))?.len();
        rustix::fs::fallocate(&file, rustix::fs::FallocateFlags::empty(), 0, bytes)
            .map_err(|e| reserved(bytes, e.into()))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests;
