//! The mission clock of the simulator, and its members' grants.

use crate::payload;

/// Services are told apart by small numbers ([`crate::ServiceName::code`]); this is the end of their range.
pub const MAX_SERVICES: usize = 16;

payload! {
    /// `clock`: the present tick; a whole state, sent again every 100 ms of wall time.
    pub struct ClockTick [112] {
        /// Which life of the simulator this is.
        pub incarnation: u64,
        /// Tick number; tick k is the instant k x 10 ms (plus `epoch_ns`).
        pub tick: u64,
        /// Mission time, nanoseconds.
        pub now_ns: u64,
        /// Datagrams that the simulator has sent to px4-link so far.
        pub datagrams: u64,
        /// Bit s is set while the member with service code s is in.
        pub members_in: u64,
        /// How often each member was found out; a member that sees its own count grow rejoins.
        pub outs: [u32; MAX_SERVICES],
        /// 1 while a run like this repeats bit for bit: no member was ever out, no datagram was lost, nobody else flew.
        pub repeats: u32,
        /// Unused, zero.
        pub reserved: u32,
    }
}

payload! {
    /// `clock/grant`: a member has finished a tick; a whole state, sent again every 100 ms of wall time.
    pub struct ClockGrant [56] {
        /// Incarnation of the clock that is granted.
        pub clock_incarnation: u64,
        /// Tick that is finished.
        pub tick: u64,
        /// Real progress: grows while the member works, never by a timer.
        pub work: u64,
        /// Datagrams that px4-link has sent so far; 0 from others.
        pub datagrams: u64,
        /// Which life of the member this is.
        pub incarnation: u64,
        /// [`crate::ServiceName`] code.
        pub service: u32,
        /// Process id, for the pidfd.
        pub pid: u32,
        /// 1: leaves for good, is no out.
        pub leaving: u32,
        /// 1: held by a debugger, is waited for without limit.
        pub held: u32,
    }
}
