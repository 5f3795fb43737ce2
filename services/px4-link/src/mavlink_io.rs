//! The connection: bytes to messages and back, robust to garbage, pinned to one autopilot.
//!
//! UDP has a socket of its own, so that lockstep can take exactly the datagrams that the clock has counted, and count what
//! it sent. TCP and serial lines (wall mode only) use the `mavlink` crate's connection with a reader thread and a bounded
//! queue.

use std::collections::VecDeque;
use std::net::{SocketAddr, UdpSocket};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use mavlink::dialects::common::{MavAutopilot, MavMessage};
use mavlink::{MAVLinkV2MessageRaw, MavConnection, MavHeader, MavlinkVersion, Message};

/// The component that px4-link is: MAV_COMP_ID_ONBOARD_COMPUTER.
pub const OWN_COMPONENT: u8 = 191;
const QUEUE: usize = 1024;
const MISSING_LIMIT: Duration = Duration::from_millis(200);

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

/// A message and who sent it.
#[derive(Debug, Clone)]
pub struct Received {
    /// System id of the sender.
    pub system: u8,
    /// Component id of the sender.
    pub component: u8,
    /// What it says.
    pub message: MavMessage,
}

/// Messages in a piece of bytes. Garbage, torn frames, wrong checksums and unknown messages are skipped.
#[must_use]
pub fn decode(mut bytes: &[u8]) -> Vec<Received> {
    let mut messages = Vec::new();
    while let Some(start) = bytes.iter().position(|&b| b == mavlink::MAV_STX_V2 || b == mavlink::MAV_STX) {
        bytes = bytes.get(start..).unwrap_or_default();
        match frame(bytes) {
            Some((length, received)) => {
                messages.extend(received);
                bytes = bytes.get(length..).unwrap_or_default();
            }
            None => bytes = bytes.get(1..).unwrap_or_default(),
        }
    }
    messages
}

/// A whole frame at the start of the bytes: its length, and its message when we know it.
fn frame(bytes: &[u8]) -> Option<(usize, Option<Received>)> {
    let v2 = *bytes.first()? == mavlink::MAV_STX_V2;
    let payload_len = usize::from(*bytes.get(1)?);
    let (header_len, system, component, id, signed) = if v2 {
        let id = u32::from_le_bytes([*bytes.get(7)?, *bytes.get(8)?, *bytes.get(9)?, 0]);
        (10, *bytes.get(5)?, *bytes.get(6)?, id, bytes.get(2)? & 1 == 1)
    } else {
        (6, *bytes.get(3)?, *bytes.get(4)?, u32::from(*bytes.get(5)?), false)
    };
    let end = header_len + payload_len;
    let sum = u16::from_le_bytes([*bytes.get(end)?, *bytes.get(end + 1)?]);
    if mavlink::calculate_crc(bytes.get(1..end)?, MavMessage::extra_crc(id)) != sum {
        return None;
    }
    let length = end + 2 + if signed { 13 } else { 0 };
    let version = if v2 { MavlinkVersion::V2 } else { MavlinkVersion::V1 };
    let message = MavMessage::parse(version, id, bytes.get(header_len..end)?).ok();
    Some((length, message.map(|message| Received { system, component, message })))
}

/// A MAVLink 2 frame of a message.
#[must_use]
pub fn encode(system: u8, sequence: u8, message: &MavMessage) -> Vec<u8> {
    let header = MavHeader { system_id: u32::from(system), component_id: OWN_COMPONENT, sequence };
    let mut raw = MAVLinkV2MessageRaw::new();
    raw.serialize_message(header, message);
    raw.raw_bytes().to_vec()
}

type StreamConnection = mavlink::Connection<MavMessage>;

enum Way {
    Udp(Arc<UdpSocket>),
    Stream(Arc<OnceLock<StreamConnection>>),
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
            Way::Stream(connection) => {
                let header = MavHeader { system_id: u32::from(system), component_id: OWN_COMPONENT, sequence };
                connection.get().is_some_and(|connection| connection.send(&header, message).is_ok())
            }
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
    /// Datagrams of the peer taken, as the clock counts them.
    taken: u64,
    /// Datagrams that the clock counted and that never came.
    pub missing: u64,
    /// Datagrams and messages of others.
    pub foreign: u64,
    /// Whether the clock's count has been taken over since the last (re)join.
    joined: bool,
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
            let slot = Arc::new(OnceLock::new());
            let (url_of_thread, slot_of_thread) = (url.to_owned(), Arc::clone(&slot));
            std::thread::Builder::new()
                .name("link-reader".to_owned())
                .spawn(move || read_stream(&url_of_thread, &slot_of_thread, &send))
                .map_err(failed)?;
            (Way::Stream(slot), None, Some(receive))
        };
        let shared =
            Shared { way, peer: OnceLock::new(), first_address, sequence: AtomicU8::new(0), sent: AtomicU64::new(0) };
        Ok(Self {
            sender: Sender(Arc::new(shared)),
            reader,
            waiting: VecDeque::new(),
            taken: 0,
            missing: 0,
            foreign: 0,
            joined: false,
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

    /// Lockstep: takes the datagrams that the clock has counted. On joining, whatever is there; the count is taken over.
    /// One that is still missing after 200 ms of wall time is counted and given up.
    pub fn drain_to(&mut self, datagrams: u64) {
        if !self.joined {
            self.take_all();
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

    /// Lockstep: was out. The next drain takes the clock's count over, and drops what came before.
    pub fn rejoin(&mut self) {
        self.joined = false;
        self.waiting.clear();
    }

    /// Takes everything that has come.
    pub fn take_all(&mut self) {
        while self.take_one() {}
    }

    /// The next message of the pinned autopilot's system.
    pub fn next_message(&mut self) -> Option<Received> {
        self.waiting.pop_front()
    }

    /// Takes one datagram or message. False when none is there.
    fn take_one(&mut self) -> bool {
        if let Some(reader) = &self.reader {
            return match reader.try_recv() {
                Ok(received) => {
                    self.accept(None, received);
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

/// Reads a TCP or serial line for ever; drops messages while the queue is full.
fn read_stream(url: &str, slot: &OnceLock<StreamConnection>, queue: &SyncSender<Received>) {
    let again = Duration::from_secs(1);
    let connection = loop {
        match mavlink::connect::<MavMessage>(url) {
            Ok(connection) => break slot.get_or_init(|| connection),
            Err(error) => {
                tracing::warn!(url, %error, "cannot reach the autopilot; trying again");
                std::thread::sleep(again);
            }
        }
    };
    loop {
        match connection.recv() {
            Ok((header, message)) => {
                let Ok(system) = u8::try_from(header.system_id) else { continue };
                let received = Received { system, component: header.component_id, message };
                match queue.try_send(received) {
                    Err(std::sync::mpsc::TrySendError::Disconnected(_)) => return,
                    Ok(()) | Err(std::sync::mpsc::TrySendError::Full(_)) => {}
                }
            }
            Err(mavlink::error::MessageReadError::Parse(_)) => {}
            Err(error) => {
                tracing::warn!(url, %error, "the line to the autopilot broke");
                std::thread::sleep(again);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use mavlink::dialects::common::{HEARTBEAT_DATA, TIMESYNC_DATA};
    use proptest::prelude::*;

    use super::*;

    fn heartbeat(autopilot: MavAutopilot) -> MavMessage {
        MavMessage::HEARTBEAT(HEARTBEAT_DATA { autopilot, mavlink_version: 3, ..Default::default() })
    }

    fn framed(system: u8, component: u8, message: &MavMessage) -> Vec<u8> {
        let mut raw = MAVLinkV2MessageRaw::new();
        raw.serialize_message(
            MavHeader { system_id: u32::from(system), component_id: component, sequence: 0 },
            message,
        );
        raw.raw_bytes().to_vec()
    }

    proptest! {
        #[test]
        fn garbage_never_panics_and_never_hides_a_whole_frame(
            before in proptest::collection::vec(any::<u8>(), 0..200), after in proptest::collection::vec(any::<u8>(), 0..40), ts in any::<i64>(),
        ) {
            // A start byte in the garbage could claim the frame as its own payload; with a right checksum by chance 1:65536.
            let message = MavMessage::TIMESYNC(TIMESYNC_DATA { tc1: 5, ts1: ts, ..Default::default() });
            let bytes = [before, encode(1, 9, &message), after].concat();
            let found = decode(&bytes);
            prop_assert!(found.iter().any(|received| received.message == message && received.component == OWN_COMPONENT));
        }
    }

    #[test]
    fn only_the_first_autopilot_is_heard() {
        let mut link = Link::open("udpin:127.0.0.1:0", false).expect("a free port");
        let to = link.local_address().expect("udp");
        let socket = |_: u8| UdpSocket::bind("127.0.0.1:0").expect("a free port");
        let (station, autopilot, other) = (socket(0), socket(1), socket(2));
        station.send_to(&framed(255, 190, &heartbeat(MavAutopilot::MAV_AUTOPILOT_INVALID)), to).expect("sent");
        autopilot.send_to(&framed(3, 154, &heartbeat(MavAutopilot::MAV_AUTOPILOT_PX4)), to).expect("sent");
        link.take_all();
        assert!(
            link.sender().peer().is_none()
                && link.foreign == 2
                && !link.sender().send(&heartbeat(MavAutopilot::MAV_AUTOPILOT_INVALID))
        );
        autopilot.send_to(&framed(3, 1, &heartbeat(MavAutopilot::MAV_AUTOPILOT_PX4)), to).expect("sent");
        other.send_to(&framed(3, 1, &heartbeat(MavAutopilot::MAV_AUTOPILOT_PX4)), to).expect("sent");
        link.take_all();
        assert_eq!(link.sender().peer().map(|peer| peer.system), Some(3));
        assert!(link.next_message().is_some() && link.next_message().is_none());
        assert!(link.sender().send(&heartbeat(MavAutopilot::MAV_AUTOPILOT_INVALID)) && link.sender().sent() == 1);
    }

    #[test]
    fn in_lockstep_exactly_the_counted_datagrams_are_taken() {
        let mut link = Link::open("udpin:127.0.0.1:0", true).expect("a free port");
        let to = link.local_address().expect("udp");
        let autopilot = UdpSocket::bind("127.0.0.1:0").expect("a free port");
        let send = |count: usize| {
            for _ in 0..count {
                autopilot.send_to(&framed(1, 1, &heartbeat(MavAutopilot::MAV_AUTOPILOT_PX4)), to).expect("sent");
            }
        };
        let drain = |link: &mut Link, to: u64| {
            link.drain_to(to);
            core::iter::from_fn(|| link.next_message()).count()
        };
        send(2);
        assert_eq!(drain(&mut link, 40), 2, "joining takes the count over");
        send(3);
        assert_eq!(drain(&mut link, 42), 2);
        assert_eq!(drain(&mut link, 43), 1);
        assert_eq!((drain(&mut link, 44), link.missing), (0, 1), "a lost one is given up");
        assert!(matches!(Link::open("tcpout:127.0.0.1:5760", true), Err(LinkError::NotCountable(_))));
    }
}
