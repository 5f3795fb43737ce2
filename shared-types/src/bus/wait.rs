//! Waiting without turning: on messages, timers, foreign descriptors and the stop signal at once.

use std::cell::{Cell, RefCell};
use std::os::fd::{AsFd as _, BorrowedFd};
use std::time::{Duration, Instant};

use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::event::PortFactory;
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::{BusError, Ipc};
use crate::channel::{MAX_NODES, MAX_PUBLISHERS, MAX_SUBSCRIBERS};

pub(super) fn event(node: &Node<Ipc>, channel: &'static str) -> Result<PortFactory<Ipc>, BusError> {
    let failed = |cause: String| BusError::Channel { channel, cause };
    let name: iceoryx2::service::service_name::ServiceName =
        channel.try_into().map_err(|e| failed(format!("{e:?}")))?;
    let mut last = String::new();
    for attempt in 0..20 {
        let opened = node
            .service_builder(&name)
            .event()
            .max_listeners(MAX_SUBSCRIBERS)
            .max_notifiers(MAX_PUBLISHERS)
            .max_nodes(MAX_NODES)
            .event_id_max_value(3)
            .open_or_create();
        match opened {
            Ok(factory) => return Ok(factory),
            Err(cause) => last = format!("{cause:?}"),
        }
        std::thread::sleep(Duration::from_millis(10 << (attempt / 4)));
    }
    Err(failed(last))
}

/// Wakes the listeners of a channel.
pub(super) struct Notifier {
    raw: RefCell<iceoryx2::port::notifier::Notifier<Ipc>>,
    factory: PortFactory<Ipc>,
    renewed_at: Cell<Instant>,
    channel: &'static str,
}

/// A notifier that reaches too few listeners is made anew at most this often: dead listeners count until they are reaped.
const RENEW_AFTER: Duration = Duration::from_millis(200);

impl Notifier {
    pub(super) fn notify(&self) {
        let reached = match self.raw.borrow().notify() {
            Ok(reached) => reached,
            Err(error) => {
                // Readers also look by timer: a lost wake-up costs time, not a message.
                tracing::trace!(channel = self.channel, ?error, "could not wake every reader");
                0
            }
        };
        // A listener that was being made while this notifier connected stays unconnected for ever: a notifier tries each
        // listener once. Only a new notifier finds it.
        if reached < self.factory.dynamic_config().number_of_listeners()
            && self.renewed_at.get().elapsed() > RENEW_AFTER
        {
            self.renewed_at.set(Instant::now());
            match self.factory.notifier_builder().create() {
                Ok(raw) => {
                    self.raw.replace(raw);
                }
                Err(error) => tracing::debug!(channel = self.channel, ?error, "could not renew a notifier"),
            }
        }
    }
}

pub(super) fn notifier(node: &Node<Ipc>, channel: &'static str) -> Result<Notifier, BusError> {
    let factory = event(node, channel)?;
    let raw =
        factory.notifier_builder().create().map_err(|cause| BusError::Port { channel, cause: format!("{cause:?}") })?;
    Ok(Notifier { raw: RefCell::new(raw), factory, renewed_at: Cell::new(Instant::now()), channel })
}

/// Is woken when something is sent on its channel.
#[derive(Debug)]
pub struct Listener {
    raw: iceoryx2::port::listener::Listener<Ipc>,
}

pub(super) fn listener(node: &Node<Ipc>, channel: &'static str) -> Result<Listener, BusError> {
    let raw = event(node, channel)?
        .listener_builder()
        .create()
        .map_err(|cause| BusError::Port { channel, cause: format!("{cause:?}") })?;
    Ok(Listener { raw })
}

impl Listener {
    fn drain(&self) {
        if let Err(error) = self.raw.try_wait(|_| ()) {
            tracing::trace!(?error, "could not drain a wake-up");
        }
    }

    fn fd(&self) -> BorrowedFd<'_> {
        let raw = self.raw.file_descriptor();
        #[expect(unsafe_code, reason = "iceoryx2 hands out the number only")]
        // SAFETY: the descriptor belongs to the listener, which the returned borrow keeps alive.
        unsafe {
            BorrowedFd::borrow_raw(raw.native_handle())
        }
    }
}

/// Sleeps until a listener is woken, a descriptor is readable, or the time is over. Listeners that were woken are drained;
/// all of them when the time is over.
///
/// The latter because iceoryx2 0.10 can swallow wake-ups: a listener that drains resets its "notified" mark and then empties
/// its socket. A notifier that comes in between has its byte emptied and then sets the mark, and while the mark is set no
/// notifier sends a byte, for ever (a mission in five ran at a tenth of its speed). Draining clears the mark, so that such
/// a race costs one timer's period and no more; the message itself is read all the same.
///
/// # Errors
/// When the operating system refuses to wait; a signal only ends the wait.
pub fn wait(listeners: &[&Listener], fds: &[BorrowedFd<'_>], timeout: Duration) -> Result<(), BusError> {
    let mut watched: Vec<PollFd<'_>> = listeners
        .iter()
        .map(|listener| PollFd::from_borrowed_fd(listener.fd(), PollFlags::IN))
        .chain(fds.iter().map(|fd| PollFd::from_borrowed_fd(fd.as_fd(), PollFlags::IN)))
        .collect();
    let timeout = Timespec {
        tv_sec: i64::try_from(timeout.as_secs()).unwrap_or(i64::MAX),
        tv_nsec: i64::from(timeout.subsec_nanos()),
    };
    let ready = match poll(&mut watched, Some(&timeout)) {
        Ok(ready) => ready,
        Err(rustix::io::Errno::INTR) => return Ok(()),
        Err(error) => return Err(BusError::Wait { cause: error.to_string() }),
    };
    for (listener, polled) in listeners.iter().zip(&watched) {
        if ready == 0 || polled.revents().contains(PollFlags::IN) {
            listener.drain();
        }
    }
    Ok(())
}
