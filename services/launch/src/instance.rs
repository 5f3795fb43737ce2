//! Which of PX4's instances a simulated mission uses: instance i has the ports 14540+i, 14580+i and 18570+i.
//!
//! The instance is claimed for the life of this process by an abstract unix socket, which leaves no file and cannot be
//! left behind by a kill; that the ports are free of others is checked by binding them for an instant.

use std::net::UdpSocket;
use std::os::linux::net::SocketAddrExt as _;
use std::os::unix::net::{SocketAddr, UnixDatagram};

/// Instances that PX4's rule knows.
pub const INSTANCES: u16 = 10;

/// A claimed instance; given back when dropped.
#[derive(Debug)]
pub struct Claim {
    /// Number of the instance.
    pub instance: u16,
    _socket: UnixDatagram,
}

/// The UDP ports of an instance that the simulator and px4-link bind.
#[must_use]
pub fn ports_of(instance: u16) -> [u16; 3] {
    [14540 + instance, 14580 + instance, 18570 + instance]
}

/// Ports of an instance that another process has bound.
#[must_use]
pub fn busy_ports(instance: u16) -> Vec<u16> {
    ports_of(instance).into_iter().filter(|port| UdpSocket::bind(("127.0.0.1", *port)).is_err()).collect()
}

/// Claims an instance, if no other mission has it and its ports are free.
#[must_use]
pub fn claim(instance: u16) -> Option<Claim> {
    let address = SocketAddr::from_abstract_name(format!("vantage-instance-{instance}")).ok()?;
    let socket = UnixDatagram::bind_addr(&address).ok()?;
    busy_ports(instance).is_empty().then_some(Claim { instance, _socket: socket })
}

/// Claims the first instance that is free.
#[must_use]
pub fn claim_first() -> Option<Claim> {
    (0..INSTANCES).find_map(claim)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_instance_is_claimed_once_and_given_back() {
        let first = claim_first().expect("one is free");
        assert!(claim(first.instance).is_none(), "claimed twice");
        let second = claim_first().expect("another is free");
        assert_ne!(first.instance, second.instance);
        let instance = first.instance;
        drop(first);
        assert!(claim(instance).is_some());
    }

    #[test]
    fn an_instance_whose_port_is_taken_is_not_claimed() {
        let free = claim_first().expect("one is free").instance;
        let Ok(_taken) = UdpSocket::bind(("127.0.0.1", 14580 + free)) else { return };
        assert_eq!(busy_ports(free), [14580 + free]);
        assert!(claim(free).is_none());
    }
}
