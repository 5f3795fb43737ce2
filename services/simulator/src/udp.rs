//! The two UDP sockets of an instance, by PX4's rule: 14580+i to 14540+i for clients on board, 18570+i to 14550 for
//! ground stations, all on the loopback.

use std::io::ErrorKind;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};

use crate::simulator::LinkId;

/// Ports at instance 0.
const ONBOARD_PORT: u16 = 14_580;
const ONBOARD_PEER: u16 = 14_540;
const GROUND_PORT: u16 = 18_570;
const GROUND_PEER: u16 = 14_550;
/// Instances that are tried; PX4's clients know 14540 to 14549.
const INSTANCES: u8 = 10;
/// Room for the largest datagram.
const BUFFER: usize = 65_536;

/// Why the ports were not had.
#[derive(Debug, thiserror::Error)]
pub enum UdpError {
    /// A fixed instance's port is taken.
    #[error(
        "UDP port {port} of simulator instance {instance} cannot be bound ({source}): another PX4 or simulator uses it; stop it or choose another instance"
    )]
    Taken {
        /// The instance.
        instance: u8,
        /// The port.
        port: u16,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
    /// None of the instances is free.
    #[error(
        "no simulator instance from 0 to {last} has its UDP ports free (from {ONBOARD_PORT} and {GROUND_PORT}): stop other PX4s or simulators"
    )]
    AllTaken {
        /// The last instance that was tried.
        last: u8,
    },
    /// A socket failed.
    #[error("the MAVLink socket failed: {0}")]
    Socket(#[from] std::io::Error),
}

/// A datagram that came.
#[derive(Debug, Clone, Copy)]
pub struct Received<'a> {
    /// Over which link.
    pub link: LinkId,
    /// Its bytes.
    pub bytes: &'a [u8],
    /// It came from another port than the link's peer.
    pub foreign: bool,
    /// Who sent it.
    pub from: SocketAddr,
}

/// The sockets.
#[derive(Debug)]
pub struct UdpLinks {
    instance: u8,
    onboard: UdpSocket,
    ground: UdpSocket,
    buffer: Vec<u8>,
    sent_onboard: u64,
    received_onboard: u64,
}

fn local(port: u16) -> SocketAddr {
    SocketAddr::V4(SocketAddrV4::new(Ipv4Addr::LOCALHOST, port))
}

impl UdpLinks {
    /// Binds a fixed instance, or the first free one.
    ///
    /// # Errors
    /// The ports are taken.
    pub fn bind(instance: Option<u8>) -> Result<Self, UdpError> {
        if let Some(instance) = instance {
            return Self::bind_instance(instance);
        }
        for instance in 0..INSTANCES {
            match Self::bind_instance(instance) {
                Err(UdpError::Taken { source, .. }) if source.kind() == ErrorKind::AddrInUse => {}
                other => return other,
            }
        }
        Err(UdpError::AllTaken { last: INSTANCES - 1 })
    }

    fn bind_instance(instance: u8) -> Result<Self, UdpError> {
        let open = |base: u16| {
            let port = base + u16::from(instance);
            UdpSocket::bind(local(port)).map_err(|source| UdpError::Taken { instance, port, source })
        };
        let (onboard, ground) = (open(ONBOARD_PORT)?, open(GROUND_PORT)?);
        onboard.set_nonblocking(true)?;
        ground.set_nonblocking(true)?;
        Ok(Self { instance, onboard, ground, buffer: vec![0; BUFFER], sent_onboard: 0, received_onboard: 0 })
    }

    /// Which instance this is.
    #[must_use]
    pub fn instance(&self) -> u8 {
        self.instance
    }

    /// Where clients on board listen.
    #[must_use]
    pub fn onboard_peer(&self) -> SocketAddr {
        local(ONBOARD_PEER + u16::from(self.instance))
    }

    /// Datagrams sent to the client on board so far.
    #[must_use]
    pub fn sent_onboard(&self) -> u64 {
        self.sent_onboard
    }

    /// Datagrams read from the client on board (not foreign ones) so far.
    #[must_use]
    pub fn received_onboard(&self) -> u64 {
        self.received_onboard
    }

    /// The sockets, to wait on.
    #[must_use]
    pub fn sockets(&self) -> [&UdpSocket; 2] {
        [&self.onboard, &self.ground]
    }

    /// Reads the next datagram that has come; `None` when there is none.
    ///
    /// # Errors
    /// The socket failed.
    pub fn receive(&mut self) -> Result<Option<Received<'_>>, UdpError> {
        let peer = self.onboard_peer();
        if let Some((length, from)) = next(&self.onboard, &mut self.buffer)? {
            let foreign = from != peer;
            self.received_onboard += u64::from(!foreign);
            let bytes = self.buffer.get(..length).unwrap_or(&[]);
            return Ok(Some(Received { link: LinkId::Onboard, bytes, foreign, from }));
        }
        if let Some((length, from)) = next(&self.ground, &mut self.buffer)? {
            let bytes = self.buffer.get(..length).unwrap_or(&[]);
            return Ok(Some(Received { link: LinkId::Ground, bytes, foreign: true, from }));
        }
        Ok(None)
    }

    /// Sends a datagram to its link's peer. Nobody listening there is no error.
    ///
    /// # Errors
    /// The socket failed.
    pub fn send(&mut self, link: LinkId, datagram: &[u8]) -> Result<(), UdpError> {
        let (socket, peer) = match link {
            LinkId::Onboard => (&self.onboard, self.onboard_peer()),
            LinkId::Ground => (&self.ground, local(GROUND_PEER)),
        };
        match socket.send_to(datagram, peer) {
            Ok(_) => {}
            // The peer's port is closed, or the send buffer is full: UDP loses datagrams.
            Err(e)
                if matches!(
                    e.kind(),
                    ErrorKind::ConnectionRefused | ErrorKind::WouldBlock | ErrorKind::Interrupted
                ) => {}
            Err(e) => return Err(e.into()),
        }
        if link == LinkId::Onboard {
            self.sent_onboard += 1;
        }
        Ok(())
    }
}

fn next(socket: &UdpSocket, buffer: &mut [u8]) -> Result<Option<(usize, SocketAddr)>, std::io::Error> {
    loop {
        match socket.recv_from(buffer) {
            Ok(got) => return Ok(Some(got)),
            Err(e) if e.kind() == ErrorKind::WouldBlock => return Ok(None),
            // An earlier send met a closed port.
            Err(e) if matches!(e.kind(), ErrorKind::ConnectionRefused | ErrorKind::Interrupted) => {}
            Err(e) => return Err(e),
        }
    }
}
