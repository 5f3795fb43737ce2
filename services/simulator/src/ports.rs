//! All of the simulator's IPC: the clock and its grants, and the truth.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use glam::DVec3;
use shared_types::bus::{Bus, BusError, Listener, Publisher, Subscriber, wait};
use shared_types::channel::{ClockChannel, GrantChannel, TruthChannel};
use shared_types::config::CameraConfig;
use shared_types::frames::Pose;
use shared_types::messages::{ClockTick, Truth};

use crate::clock::{Grant, Lockstep};
use crate::vehicle::TrueState;

/// The simulator's ends of its channels.
#[derive(Debug)]
pub struct Ports {
    clock: Publisher<ClockChannel>,
    truth: Publisher<TruthChannel>,
    grants: Subscriber<GrantChannel>,
    granted: Listener,
    incarnation: u64,
}

impl Ports {
    /// Opens the channels.
    ///
    /// # Errors
    /// The bus refuses one.
    pub fn open(bus: &Bus, incarnation: u64) -> Result<Self, BusError> {
        Ok(Self {
            clock: bus.publisher()?,
            truth: bus.publisher()?,
            grants: bus.subscriber()?,
            granted: bus.listener::<GrantChannel>()?,
            incarnation,
        })
    }

    /// The grants that have come, oldest first.
    ///
    /// # Errors
    /// The bus fails.
    pub fn take_grants(&mut self) -> Result<Vec<Grant>, BusError> {
        let mut grants = Vec::new();
        while let Some(message) = self.grants.receive(0)? {
            let g = message.header();
            grants.push(Grant {
                clock_incarnation: g.clock_incarnation,
                service: g.service,
                incarnation: g.incarnation,
                pid: g.pid,
                tick: g.tick,
                work: g.work,
                datagrams: g.datagrams,
                leaving: g.leaving != 0,
                held: g.held != 0,
            });
        }
        Ok(grants)
    }

    /// Sends the clock's state. No free chunk is no error: the state goes out again within 100 ms.
    ///
    /// # Errors
    /// The bus fails.
    pub fn send_clock(&mut self, clock: &Lockstep, now_ns: u64, datagrams: u64) -> Result<(), BusError> {
        let mut tick = ClockTick {
            incarnation: self.incarnation,
            tick: clock.tick(),
            now_ns,
            datagrams,
            members_in: clock.members_in(),
            repeats: u32::from(clock.deterministic()),
            ..ClockTick::default()
        };
        for (code, outs) in clock.outs() {
            if let Some(slot) = tick.outs.get_mut(code as usize) {
                *slot = outs;
            }
        }
        sent(self.clock.send(now_ns, now_ns, &tick))
    }

    /// Sends the truth of a tick; the camera's pose follows from the configured mount.
    ///
    /// # Errors
    /// The bus fails.
    pub fn send_truth(&mut self, now_ns: u64, truth: &TrueState, mount: &CameraConfig) -> Result<(), BusError> {
        sent(self.truth.send(now_ns, now_ns, &truth_message(now_ns, truth, mount)))
    }

    /// Sleeps until a grant comes, a descriptor is readable, or the time is over.
    ///
    /// # Errors
    /// The operating system refuses to wait.
    pub fn wait(&self, fds: &[BorrowedFd<'_>], timeout: Duration) -> Result<(), BusError> {
        wait(&[&self.granted], fds, timeout)
    }
}

fn truth_message(now_ns: u64, truth: &TrueState, mount: &CameraConfig) -> Truth {
    let body = Pose { position_m: truth.position_m, rotation: truth.world_from_body };
    let camera = mount.world_from_camera(body, truth.world_from_gimbal);
    let array = |v: DVec3| v.to_array();
    Truth {
        now_ns,
        position_m: array(truth.position_m),
        velocity_mps: array(truth.velocity_mps),
        world_from_body_xyzw: truth.world_from_body.to_array(),
        camera_position_m: array(camera.position_m),
        world_from_camera_xyzw: camera.rotation.to_array(),
    }
}

fn sent(result: Result<(), BusError>) -> Result<(), BusError> {
    match result {
        Err(BusError::NoChunk { channel }) => {
            tracing::warn!(channel, "no free chunk: a message was skipped");
            Ok(())
        }
        other => other,
    }
}
