//! The loop of a member of the simulated mission clock (architecture, "Time").

use std::time::Duration;

use super::wall::monotonic_ns;
use super::{Context, Housekeeping, Service, ServiceError, Step};
use crate::bus::{BusError, Publisher, wait};
use crate::channel::{ClockChannel, GrantChannel};
use crate::messages::{ClockGrant, ClockTick};

const IDLE: Duration = Duration::from_millis(100);
const WAITING: Duration = Duration::from_millis(2);
const RESEND_NS: u64 = 100_000_000;
/// The clock sends its state every 100 ms of wall time: without one for this long, nobody makes time any more.
const CLOCK_GONE_NS: u64 = 2_000_000_000;

struct Grants {
    publisher: Publisher<GrantChannel>,
    newest: ClockGrant,
    sent_at_ns: u64,
}

impl Grants {
    fn send(&mut self) -> Result<(), ServiceError> {
        self.sent_at_ns = monotonic_ns();
        match self.publisher.send(0, 0, &self.newest) {
            // Whole states: the next one tells the same.
            Ok(()) | Err(BusError::NoChunk { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }
}

pub(super) fn run(context: &mut Context, service: &mut impl Service) -> Result<(), ServiceError> {
    let mut ticks = context.bus.subscriber::<ClockChannel>()?;
    let listener = context.bus.listener::<ClockChannel>()?;
    let mut housekeeping = Housekeeping::new(context)?;
    let mut grants = Grants {
        publisher: context.bus.publisher()?,
        newest: ClockGrant {
            incarnation: context.incarnation,
            service: context.name.code(),
            pid: std::process::id(),
            tick: u64::MAX,
            ..ClockGrant::default()
        },
        sent_at_ns: 0,
    };
    let mut present: Option<ClockTick> = None;
    let mut granted = true;
    let mut heard_ns = monotonic_ns();
    loop {
        let timeout = if granted { IDLE } else { WAITING };
        wait(&[&listener], &[], timeout)?;
        if let Some(message) = ticks.latest(0)? {
            let tick = *message.header();
            drop(message);
            heard_ns = monotonic_ns();
            let fresh = match &present {
                None => true,
                Some(old) if old.incarnation != tick.incarnation => {
                    service.rejoin(tick.now_ns);
                    true
                }
                Some(old) => {
                    let me = context.name.code() as usize;
                    if tick.outs.get(me) > old.outs.get(me) {
                        tracing::warn!(service = %context.name, "was found out of the mission clock; looking at the state anew");
                        service.rejoin(tick.now_ns);
                    }
                    tick.tick != old.tick
                }
            };
            if fresh {
                granted = false;
                grants.newest.clock_incarnation = tick.incarnation;
                service.begin_tick(&tick);
            }
            present = Some(tick);
        }
        let now_ns = present.as_ref().map_or(0, |tick| tick.now_ns);
        if let (Some(tick), false) = (&present, granted) {
            let started = monotonic_ns();
            // Tick 0 only gathers the members: all have opened their channels before anything is sent.
            let step = if tick.tick == 0 { Step::Done } else { service.step(now_ns)? };
            grants.newest.work = service.work();
            if step != Step::Waiting {
                housekeeping.health.count_turn(monotonic_ns() - started);
                granted = true;
                grants.newest.tick = tick.tick;
                grants.newest.datagrams = service.datagrams_sent();
                grants.newest.leaving = u32::from(step == Step::Leave);
                grants.send()?;
                if step == Step::Leave {
                    return Ok(());
                }
            }
        }
        if present.is_some() && monotonic_ns().saturating_sub(grants.sent_at_ns) > RESEND_NS {
            grants.newest.work = service.work();
            grants.newest.held = u32::from(housekeeping.control.held());
            grants.send()?;
            context.bus.serve_late_joiners();
        }
        if housekeeping.turn(context, service, now_ns)? {
            grants.newest.leaving = 1;
            return grants.send();
        }
        // What is to be finished first takes mission time, and there will be none.
        if housekeeping.stopping() && monotonic_ns().saturating_sub(heard_ns) > CLOCK_GONE_NS {
            tracing::warn!(service = %context.name, "the mission clock is gone: leaving at once");
            return Ok(());
        }
    }
}
