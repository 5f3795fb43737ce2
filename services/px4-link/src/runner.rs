//! Where the streamer runs: in line in lockstep, on a thread of its own on the wall's clock.
//!
//! The thread opens no file and no channel, its stack and slot are locked in memory, and it runs before others (SCHED_FIFO)
//! where that is permitted. Its orders come through a bounded queue that never blocks the sender; what it
//! says of itself goes back through another. A link that stalls leaves it streaming: the planner's sign of life then grows
//! old, and it brakes.

use std::collections::VecDeque;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::time::{Duration, Instant};

use shared_types::realtime;

use crate::logic::setpoint_message;
use crate::mavlink_io::Sender;
use crate::stream::{Order, Report, Settings, Streamer};

const ORDERS: usize = 512;
const REPORTS: usize = 64;
const IDLE: Duration = Duration::from_millis(100);
/// Of the setpoint thread: small, so that what is locked of it is most of it.
const STACK: usize = 4 * realtime::STACK_BYTES;
/// Priority of SCHED_FIFO, where permitted.
const PRIORITY: u8 = 20;

/// The streamer, wherever it runs.
#[derive(Debug)]
pub enum Runner {
    /// Stepped by the link itself.
    Inline {
        /// The streamer.
        streamer: Box<Streamer>,
        /// To the autopilot.
        sender: Sender,
    },
    /// On its thread.
    Thread {
        /// Orders to it.
        orders: SyncSender<Order>,
        /// Orders that found the queue full, oldest first.
        waiting: VecDeque<Order>,
        /// What it says of itself.
        reports: Receiver<Report>,
        /// The newest of that.
        newest: Box<Report>,
    },
}

impl Runner {
    /// In line.
    #[must_use]
    pub fn inline(settings: Settings, sender: Sender) -> Self {
        Self::Inline { streamer: Box::new(Streamer::new(settings)), sender }
    }

    /// On a thread that counts time from `now_ns` at this moment.
    ///
    /// # Errors
    /// When no thread can be started.
    pub fn thread(settings: Settings, sender: Sender, now_ns: u64) -> std::io::Result<Self> {
        let (orders, orders_in) = sync_channel(ORDERS);
        let (reports_out, reports) = sync_channel(REPORTS);
        let streamer = Streamer::new(settings);
        let newest = Box::new(streamer.report());
        std::thread::Builder::new()
            .name("setpoints".to_owned())
            .stack_size(STACK)
            .spawn(move || run(streamer, &sender, &orders_in, &reports_out, now_ns))?;
        Ok(Self::Thread { orders, waiting: VecDeque::new(), reports, newest })
    }

    /// Gives orders.
    pub fn order(&mut self, all: Vec<Order>) {
        match self {
            Self::Inline { streamer, .. } => all.into_iter().for_each(|order| streamer.order(order)),
            Self::Thread { orders, waiting, .. } => {
                waiting.extend(all);
                while let Some(order) = waiting.pop_front() {
                    match orders.try_send(order) {
                        Ok(()) => {}
                        Err(TrySendError::Full(order)) => {
                            waiting.push_front(order);
                            break;
                        }
                        Err(TrySendError::Disconnected(_)) => break,
                    }
                }
                // A thread that is starved gets the newest positions and signs of life when it is back; the rest stays.
                if waiting.len() > ORDERS {
                    waiting.retain(|order| !matches!(order, Order::Measured { .. } | Order::Alive(_)));
                }
            }
        }
    }

    /// Lockstep: sends the setpoint that is due.
    pub fn step(&mut self, now_ns: u64) {
        if let Self::Inline { streamer, sender } = self
            && let (Some(to_send), Some(peer)) = (streamer.step(now_ns), sender.peer())
        {
            sender.send(&setpoint_message(peer.system, now_ns, &to_send));
        }
    }

    /// What the streamer says of itself.
    pub fn report(&mut self) -> Report {
        match self {
            Self::Inline { streamer, .. } => streamer.report(),
            Self::Thread { reports, newest, .. } => {
                while let Ok(report) = reports.try_recv() {
                    **newest = report;
                }
                **newest
            }
        }
    }
}

/// Asks for the thread what keeps it in time; what is not permitted is said once and left.
fn become_punctual(streamer: &Streamer) {
    use thread_priority::unix::{set_thread_priority_and_policy, thread_native_id};
    use thread_priority::{RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy};

    if let Err(error) = realtime::lock_stack().and_then(|()| realtime::lock_value(streamer)) {
        tracing::info!(%error, "the setpoint thread's memory cannot be locked (ulimit -l): it may be paged out");
    }
    let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let asked = ThreadPriorityValue::try_from(PRIORITY)
        .map(|value| set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(value), fifo));
    if !matches!(asked, Ok(Ok(()))) {
        tracing::debug!("SCHED_FIFO is not permitted for the setpoint thread");
    }
}

fn run(mut streamer: Streamer, sender: &Sender, orders: &Receiver<Order>, reports: &SyncSender<Report>, epoch_ns: u64) {
    become_punctual(&streamer);
    let started = Instant::now();
    let now = || epoch_ns + u64::try_from(started.elapsed().as_nanos()).unwrap_or(u64::MAX / 2);
    loop {
        let due_in = streamer.due_ns().map_or(IDLE, |due_ns| Duration::from_nanos(due_ns.saturating_sub(now())));
        match orders.recv_timeout(due_in.min(IDLE)) {
            Ok(order) => {
                let routine = matches!(order, Order::Measured { .. } | Order::Alive(_));
                streamer.order(order);
                if !routine && reports.try_send(streamer.report()).is_err() {
                    // The link is behind on reading: the next one tells the same.
                }
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
        let now_ns = now();
        if streamer.due_ns().is_some_and(|due_ns| due_ns <= now_ns) {
            if let (Some(to_send), Some(peer)) = (streamer.step(now_ns), sender.peer()) {
                sender.send(&setpoint_message(peer.system, now_ns, &to_send));
            }
            if reports.try_send(streamer.report()).is_err() {
                // As above.
            }
        }
    }
}
