//! One direction of a link: packets go in, and come out later, twice, in another order, damaged, or never.

use std::collections::BTreeMap;

use crate::rng::Rng;

const STX_V1: u8 = 0xFE;
const STX_V2: u8 = 0xFD;
const SIGNED: u8 = 1;
const SIGNATURE: usize = 13;
/// A packet that is overtaken is late by up to so many ticks.
const LATEST_TICKS: u64 = 3;
/// Longest run of bytes that are no packet.
const LONGEST_GARBAGE: f64 = 40.0;

/// What a link does to packets.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Disturbance {
    /// Share of packets that vanish.
    pub loss: f64,
    /// How long every packet takes, ticks of 10 ms.
    pub delay_ticks: u64,
    /// Share of packets that come twice.
    pub duplicate: f64,
    /// Share of packets that are overtaken.
    pub reorder: f64,
    /// Share of packets with garbage beside them.
    pub garbage: f64,
    /// Nothing comes through.
    pub gone: bool,
    /// Heartbeats do not come through.
    pub heartbeats_lost: bool,
}

/// One direction of a link.
#[derive(Debug, Clone)]
pub struct Lane {
    rng: Rng,
    /// By the tick in which they arrive, then by the order of their sending.
    waiting: BTreeMap<(u64, u64), Vec<u8>>,
    sequence: u64,
}

impl Lane {
    /// An empty lane; its seed decides what is lost.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self { rng: Rng::new(seed), waiting: BTreeMap::new(), sequence: 0 }
    }

    /// Sends a datagram, packet by packet.
    pub fn push(&mut self, tick: u64, datagram: &[u8], disturbance: &Disturbance) {
        for packet in packets(datagram) {
            let lost = disturbance.gone
                || self.rng.uniform() <= disturbance.loss
                || disturbance.heartbeats_lost && is_heartbeat(packet);
            if lost {
                continue;
            }
            let mut due = tick + disturbance.delay_ticks;
            if self.rng.uniform() <= disturbance.reorder {
                due += 1 + (self.rng.uniform() * LATEST_TICKS as f64) as u64 % LATEST_TICKS;
            }
            if self.rng.uniform() <= disturbance.garbage {
                let garbage = self.garbage(packet);
                self.put(due, garbage);
            }
            self.put(due, packet.to_vec());
            if self.rng.uniform() <= disturbance.duplicate {
                self.put(due, packet.to_vec());
            }
        }
    }

    /// What arrives up to a tick, in order.
    pub fn take(&mut self, tick: u64) -> Vec<Vec<u8>> {
        let later = self.waiting.split_off(&(tick + 1, 0));
        core::mem::replace(&mut self.waiting, later).into_values().collect()
    }

    fn put(&mut self, due: u64, bytes: Vec<u8>) {
        self.sequence += 1;
        self.waiting.insert((due, self.sequence), bytes);
    }

    /// Bytes of chance, or the packet with one bit turned.
    fn garbage(&mut self, packet: &[u8]) -> Vec<u8> {
        if self.rng.uniform() < 0.5 {
            let mut damaged = packet.to_vec();
            let at = (self.rng.uniform() * damaged.len() as f64) as usize;
            if let Some(byte) = damaged.get_mut(at) {
                *byte ^= 1 << ((self.rng.uniform() * 8.0) as u32 % 8);
            }
            return damaged;
        }
        let length = 1 + (self.rng.uniform() * LONGEST_GARBAGE) as usize;
        (0..length).map(|_| (self.rng.uniform() * 256.0) as u8).collect()
    }
}

/// Splits a datagram where its packets begin; what is no packet stays in one piece.
fn packets(mut rest: &[u8]) -> impl Iterator<Item = &[u8]> {
    core::iter::from_fn(move || {
        let length = match rest {
            [] => return None,
            [STX_V2, payload, incompatible, ..] => {
                12 + usize::from(*payload) + if incompatible & SIGNED == 0 { 0 } else { SIGNATURE }
            }
            [STX_V1, payload, ..] => 8 + usize::from(*payload),
            _ => rest.len(),
        };
        let (packet, after) = rest.split_at(length.min(rest.len()));
        rest = after;
        Some(packet)
    })
}

fn is_heartbeat(packet: &[u8]) -> bool {
    match packet {
        [STX_V2, _, _, _, _, _, _, id @ ..] => id.starts_with(&[0, 0, 0]),
        [STX_V1, _, _, _, _, id, ..] => *id == 0,
        _ => false,
    }
}
