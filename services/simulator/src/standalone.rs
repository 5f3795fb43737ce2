//! The vehicle alone, on the wall's clock: for clients of other makers, and for a real-time simulator without members.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::simulator::Simulator;
use crate::udp::{UdpError, UdpLinks};
use crate::vehicle::{BadParameter, TICK_NS, TrueState, VehicleConfig};

/// Longest wait for a datagram, so that a stop is seen soon.
const WAIT_MAX: Duration = Duration::from_millis(50);
/// More than this behind the wall's clock (a stopped process, a suspended machine), the lost time is given up.
const BEHIND_MAX: Duration = Duration::from_millis(500);

/// Why it ended.
#[derive(Debug, thiserror::Error)]
pub enum StandaloneError {
    /// The links.
    #[error(transparent)]
    Udp(#[from] UdpError),
    /// The configuration.
    #[error(transparent)]
    Parameter(#[from] BadParameter),
    /// Waiting failed.
    #[error("waiting for MAVLink datagrams failed: {0}")]
    Wait(#[from] rustix::io::Errno),
    /// Speed makes no sense.
    #[error("simulator speed is {0}: expected a finite number above 0 (1 is real time)")]
    Speed(f64),
}

/// Runs a vehicle on bound links at a multiple of real time until `stop` is set. `each_tick` sees the time since boot
/// (ns) and the truth of every tick.
///
/// # Errors
/// A bad parameter or speed, or a socket that failed.
pub fn run_standalone(
    mut links: UdpLinks,
    config: VehicleConfig,
    speed: f64,
    stop: &AtomicBool,
    mut each_tick: impl FnMut(u64, &TrueState),
) -> Result<(), StandaloneError> {
    if !speed.is_finite() || speed <= 0.0 {
        return Err(StandaloneError::Speed(speed));
    }
    let mut simulator = Simulator::new(config, links.instance())?;
    let period = Duration::from_secs_f64(TICK_NS as f64 * 1e-9 / speed);
    let mut last_tick = Instant::now();
    while !stop.load(Ordering::Relaxed) {
        while let Some(received) = links.receive()? {
            let late_ns = (last_tick.elapsed().as_secs_f64() * speed * 1e9) as u64;
            simulator.receive(received.link, received.bytes, late_ns.min(TICK_NS));
        }
        let since = last_tick.elapsed();
        if since >= period {
            simulator.step();
            last_tick = if since > BEHIND_MAX.max(period * 2) { Instant::now() } else { last_tick + period };
            each_tick(simulator.vehicle().boot_ns(), &simulator.truth());
        }
        for (link, datagram) in simulator.take_datagrams() {
            links.send(link, &datagram)?;
        }
        wait(&links, period.saturating_sub(last_tick.elapsed()).min(WAIT_MAX))?;
    }
    Ok(())
}

/// Waits for a datagram or until a time has passed.
fn wait(links: &UdpLinks, most: Duration) -> Result<(), rustix::io::Errno> {
    if most.is_zero() {
        return Ok(());
    }
    let [onboard, ground] = links.sockets();
    let mut fds = [PollFd::new(onboard, PollFlags::IN), PollFd::new(ground, PollFlags::IN)];
    let timeout = Timespec { tv_sec: most.as_secs().cast_signed(), tv_nsec: i64::from(most.subsec_nanos()) };
    match poll(&mut fds, Some(&timeout)) {
        Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
        Err(e) => Err(e),
    }
}
