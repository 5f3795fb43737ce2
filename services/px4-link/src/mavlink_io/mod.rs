//! The connection: bytes to messages and back, robust to garbage, pinned to one autopilot.
//!
//! UDP has a socket of its own, so that lockstep can take exactly the datagrams that the clock has counted, and count what
//! it sent. TCP and serial lines (wall mode only) have a reader thread and a bounded queue ([`line`]).

mod codec;
mod line;

use std::collections::VecDeque;
use std::net::{SocketAddr, UdpSocket};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use mavlink::dialects::common::{MavAutopilot, MavMessage};

use shared_types::messages::MissionCommand;

use crate::ground;
pub use codec::{Received, decode, encode, take_frames};
use line::Line;

/// The component that px4-link is: MAV_COMP_ID_ONBOARD_COMPUTER.
pub const OWN_COMPONENT: u8 = 191;
const QUEUE: usize = 1024;
/// Orders that may wait; who sends more of them sends them again.
const ORDERS_MAX: usize = 16;
const MISSING_LIMIT: Duration = Duration::from_millis(200);
/// After an absence, what a TCP or serial line still holds of it is read and dropped for this long.
const STALE_FOR: Duration = Duration::from_millis(300);

/// Why there is no connection.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The address cannot be used.
    #[error(
        "link.url is \"{url}\": {source}; expected an address that this machine can open (is another program on the port?)"
    )]
    Open {
        /// The address.
        url: String,
        /// What the system says.
        source: std::io::Error,
    },
    /// In lockstep only UDP can be counted.
    #[error(
        "link.url is \"{0}\"; expected udpin:ADDRESS:PORT with clock.mode = \"lockstep\", or set clock.mode = \"wall\""
    )]
    NotCountable(String),
}

enum Way {
    Udp(Arc<UdpSocket>),
    Stream(Arc<Line>),
}

/// The pinned peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Peer {
    /// Its system id.
    pub system: u8,
    /// Where its datagrams come from; `None` on lines that have one end only.
    pub address: Option<SocketAddr>,
}

struct Shared {
    way: Way,
    peer: OnceLock<Peer>,
    /// `udpout`: where to send before a peer is known.
    first_address: Option<SocketAddr>,
    sequence: AtomicU8,
    sent: AtomicU64,
}

/// Sends to the pinned peer; cheap to clone, one for every thread.
#[derive(Clone)]
pub struct Sender(Arc<Shared>);

impl core::fmt::Debug for Sender {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Sender").field("peer", &self.peer()).field("sent", &self.sent()).finish_non_exhaustive()
    }
}

impl Sender {
    /// The autopilot, once it was found.
    #[must_use]
    pub fn peer(&self) -> Option<Peer> {
        self.0.peer.get().copied()
    }

    /// Datagrams (or frames) sent so far.
    #[must_use]
    pub fn sent(&self) -> u64 {
        self.0.sent.load(Ordering::Relaxed)
    }

    /// Sends a message; false when it could not leave (no peer, buffer full). What matters is sent again anyway.
    pub fn send(&self, message: &MavMessage) -> bool {
        let sequence = self.0.sequence.fetch_add(1, Ordering::Relaxed);
        let system = self.peer().map_or(1, |peer| peer.system);
        let gone = match &self.0.way {
            Way::Udp(socket) => {
                let Some(address) = self.peer().and_then(|peer| peer.address).or(self.0.first_address) else {
                    return false;
                };
                socket.send_to(&encode(system, sequence, message), address).is_ok()
            }
            Way::Stream(line) => line.send(&encode(system, sequence, message)),
        };
        if gone {
            self.0.sent.fetch_add(1, Ordering::Relaxed);
        }
        gone
    }
}

/// The connection.
pub struct Link {
    sender: Sender,
    reader: Option<Receiver<Received>>,
    waiting: VecDeque<Received>,
    orders: VecDeque<(Received, MissionCommand)>,
    /// Datagrams of the peer taken, as the clock counts them.
    taken: u64,
    /// Datagrams that the clock counted and that never came.
    pub missing: u64,
    /// Datagrams and messages of others.
    pub foreign: u64,
    /// Whether the clock's count has been taken over since the last (re)join.
    joined: bool,
    /// What comes until then was sent before this process was back.
    stale_until: Option<Instant>,
    /// Was out: what waits tells of the time before.
    discards: bool,
}

impl core::fmt::Debug for Link {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Link").field("sender", &self.sender).field("taken", &self.taken).finish_non_exhaustive()
    }
}

impl Link {
    /// Opens the connection of an address.
    ///
    /// # Errors
    /// When it cannot be opened, or cannot be counted in lockstep.
    pub fn open(url: &str, lockstep: bool) -> Result<Self, LinkError> {
        let failed = |source| LinkError::Open { url: url.to_owned(), source };
        let (way, first_address, reader) = if let Some(address) = url.strip_prefix("udpin:") {
            (Way::Udp(Arc::new(bound(address).map_err(failed)?)), None, None)
        } else if let Some(address) = url.strip_prefix("udpout:") {
            let to: SocketAddr = address.parse().map_err(|error| failed(std::io::Error::other(error)))?;
            (Way::Udp(Arc::new(bound("0.0.0.0:0").map_err(failed)?)), Some(to), None)
        } else if lockstep {
            return Err(LinkError::NotCountable(url.to_owned()));
        } else {
            let (send, receive) = sync_channel(QUEUE);
            let line = Arc::new(Line::default());
            let (url_of_thread, line_of_thread) = (url.to_owned(), Arc::clone(&line));
            std::thread::Builder::new()
                .name("link-reader".to_owned())
                .spawn(move || line::read(&url_of_thread, &line_of_thread, &send))
                .map_err(failed)?;
            (Way::Stream(line), None, Some(receive))
        };
        let shared =
            Shared { way, peer: OnceLock::new(), first_address, sequence: AtomicU8::new(0), sent: AtomicU64::new(0) };
        Ok(Self {
            sender: Sender(Arc::new(shared)),
            reader,
            waiting: VecDeque::new(),
            orders: VecDeque::new(),
            taken: 0,
            missing: 0,
            foreign: 0,
            joined: false,
            stale_until: None,
            discards: false,
        })
    }

    /// A sender to the same peer.
    #[must_use]
    pub fn sender(&self) -> Sender {
        self.sender.clone()
    }

    /// The descriptor that is readable when something came.
    #[must_use]
    pub fn fd(&self) -> Option<BorrowedFd<'_>> {
        match &self.sender.0.way {
            Way::Udp(socket) => Some(socket.as_fd()),
            Way::Stream(_) => None,
        }
    }

    /// The address that is listened on.
    #[must_use]
    pub fn local_address(&self) -> Option<SocketAddr> {
        match &self.sender.0.way {
            Way::Udp(socket) => socket.local_addr().ok(),
            Way::Stream(_) => None,
        }
    }

    /// Lockstep: takes the datagrams that the clock has counted. On joining, whatever is there (and drops it where this
    /// process was out); the count is taken over.
    /// One that is still missing after 200 ms of wall time is counted and given up.
    pub fn drain_to(&mut self, datagrams: u64) {
        if !self.joined {
            self.take_all();
            if core::mem::take(&mut self.discards) {
                self.waiting.clear();
                self.orders.clear();
            }
            self.joined = true;
            self.taken = datagrams;
            return;
        }
        let started = Instant::now();
        while self.taken < datagrams {
            if self.take_one() {
                continue;
            }
            if started.elapsed() > MISSING_LIMIT {
                self.missing += datagrams - self.taken;
                tracing::warn!(missing = datagrams - self.taken, "datagrams of the simulator did not arrive");
                self.taken = datagrams;
                return;
            }
            std::thread::sleep(Duration::from_micros(50));
        }
    }

    /// This process was out or stopped: drops what came before. In lockstep the next drain takes the clock's count over.
    pub fn rejoin(&mut self) {
        self.joined = false;
        self.discards = true;
        self.waiting.clear();
        self.orders.clear();
        self.stale_until = self.reader.is_some().then(|| Instant::now() + STALE_FOR);
    }

    /// Takes everything that has come.
    pub fn take_all(&mut self) {
        while self.take_one() {}
    }

    /// The next message of the pinned autopilot's system.
    pub fn next_message(&mut self) -> Option<Received> {
        self.waiting.pop_front()
    }

    /// The next order for the mission, which the autopilot has forwarded from a ground station.
    pub fn next_order(&mut self) -> Option<(Received, MissionCommand)> {
        self.orders.pop_front()
    }

    /// Takes one datagram or message. False when none is there.
    fn take_one(&mut self) -> bool {
        if let Some(reader) = &self.reader {
            return match reader.try_recv() {
                Ok(received) => {
                    if self.stale_until.is_none_or(|until| Instant::now() > until) {
                        self.stale_until = None;
                        self.accept(None, received);
                    }
                    true
                }
                Err(TryRecvError::Empty | TryRecvError::Disconnected) => false,
            };
        }
        let Way::Udp(socket) = &self.sender.0.way else { return false };
        let mut buffer = [0u8; 65_536];
        let Ok((length, from)) = socket.recv_from(&mut buffer) else { return false };
        let messages = decode(buffer.get(..length).unwrap_or_default());
        let pinned = self.sender.peer().and_then(|peer| peer.address);
        if pinned.is_some_and(|address| address != from) {
            self.foreign += 1;
            return true;
        }
        for received in messages {
            self.accept(Some(from), received);
        }
        // Before anything is pinned, datagrams are the peer's as far as known; joining takes the count over anyway.
        self.taken += 1;
        true
    }

    fn accept(&mut self, from: Option<SocketAddr>, received: Received) {
        if self.sender.peer().is_none()
            && let MavMessage::HEARTBEAT(heartbeat) = &received.message
            && heartbeat.autopilot == MavAutopilot::MAV_AUTOPILOT_PX4
            && received.component == 1
        {
            let peer = Peer { system: received.system, address: from };
            if self.sender.0.peer.set(peer).is_ok() {
                tracing::info!(system = peer.system, address = ?peer.address, "found the autopilot");
            }
        }
        if let Some(peer) = self.sender.peer().filter(|peer| peer.address.is_none() || peer.address == from)
            && let Some(order) = ground::ordered(peer.system, &received)
        {
            if self.orders.len() < ORDERS_MAX {
                self.orders.push_back((received, order));
            }
            return;
        }
        match self.sender.peer() {
            Some(peer) if peer.system == received.system && (peer.address.is_none() || peer.address == from) => {
                if self.waiting.len() < 4 * QUEUE {
                    self.waiting.push_back(received);
                }
            }
            _ => self.foreign += 1,
        }
    }
}

fn bound(address: &str) -> std::io::Result<UdpSocket> {
    let socket = UdpSocket::bind(address)?;
    socket.set_nonblocking(true)?;
    Ok(socket)
}

#[cfg(test)]
mod tests;
