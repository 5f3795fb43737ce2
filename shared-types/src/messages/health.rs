//! Health of a service, and the commands every service takes.

use crate::{codes, payload};

codes! {
    /// What a service is doing.
    pub enum ServiceState {
        /// Opening its channels.
        Starting = 0, "starting",
        /// Working.
        Running = 1, "running",
        /// Alive, but something it needs is missing; the last error says what.
        Degraded = 2, "degraded",
        /// Leaving.
        Stopping = 3, "stopping",
        /// Cannot go on.
        Failed = 4, "failed",
    }
}

payload! {
    /// `health` and `health/last`: once a second from every service.
    pub struct Health [248] {
        /// Which life of the service this is (its start, monotonic nanoseconds).
        pub incarnation: u64,
        /// Turns of the work loop.
        pub turns: u64,
        /// Median time of a turn over the last second, nanoseconds.
        pub turn_p50_ns: u64,
        /// 99th percentile of that, nanoseconds.
        pub turn_p99_ns: u64,
        /// For how long a worker has had a job without progress, nanoseconds of wall time; 0 where none has, or it goes on.
        pub stalled_ns: u64,
        /// Resident memory, bytes.
        pub rss_bytes: u64,
        /// Messages received.
        pub received: u64,
        /// Messages sent.
        pub sent: u64,
        /// Messages lost by overflow or without a free chunk, or refused ([`super::check`]).
        pub dropped: u64,
        /// [`crate::ServiceName`] code.
        pub service: u32,
        /// Process id.
        pub pid: u32,
        /// [`ServiceState`] code.
        pub state: u32,
        /// In `health/last`: how often the service was started again since the keeper first heard of it.
        pub restarts: u32,
        /// What went wrong last; text.
        pub last_error: [u8; 160],
    }
}

codes! {
    /// What every service can be told.
    pub enum ControlCommand {
        /// End in order.
        Stop = 1, "stop",
        /// Set the log level to `argument` (0 error .. 4 trace).
        LogLevel = 2, "log-level",
        /// Stop working until the debugger lets go (`argument` 1), or go on (0).
        DebugHold = 3, "debug-hold",
    }
}

payload! {
    /// Request of `control/<service>`.
    pub struct ControlRequest [16] {
        /// [`ControlCommand`] code.
        pub command: u32,
        /// See the command.
        pub argument: u32,
        /// [`crate::ServiceName`] code of the service that is meant.
        pub service: u32,
        /// Unused, zero.
        pub reserved: u32,
    }
}

payload! {
    /// Reply of `control/<service>`.
    pub struct ControlReply [8] {
        /// 1 when done, 0 when refused.
        pub accepted: u32,
        /// [`crate::ServiceName`] code of the service that answers.
        pub service: u32,
    }
}
