//! The mission clock's logic, apart from processes and channels: who has granted, who is out, when the next tick may
//! begin. Wall time comes in as an argument, in nanoseconds of a monotonic clock.
//!
//! The clock stands in one of three states ([`Phase`]): it gathers its members at tick 0, it waits for grants, or every
//! grant is there and only the speed limit holds it back.

use std::collections::BTreeMap;

/// Members must all have granted tick 0 within this time.
pub const GATHER_NS: u64 = 60_000_000_000;
/// A member whose tick and work stand still for this long is out.
const STILL_NS: u64 = 2_000_000_000;
/// A datagram that is still missing after this time is counted, and time goes on.
const DATAGRAM_NS: u64 = 200_000_000;
/// A member that has left may have been asked to, alone, and is started again: for so long time goes no faster than the
/// wall's, so that it misses no deadline.
const LEFT_NS: u64 = 2_000_000_000;
/// The state is sent again this often.
const RESEND_NS: u64 = 100_000_000;
/// A tick of simulated time.
const TICK_NS: f64 = 10e6;

/// A grant, as a member sends it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Grant {
    /// The clock's incarnation that is granted.
    pub clock_incarnation: u64,
    /// The member's service code.
    pub service: u32,
    /// Which life of the member this is; a later life has a greater number.
    pub incarnation: u64,
    /// Its process.
    pub pid: u32,
    /// The tick it has finished.
    pub tick: u64,
    /// Grows while it works.
    pub work: u64,
    /// Datagrams it has sent to the vehicle.
    pub datagrams: u64,
    /// It leaves for good.
    pub leaving: bool,
    /// A debugger holds it.
    pub held: bool,
}

/// What the clock waits for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Phase {
    /// Tick 0: these members have not granted yet.
    Gathering(Vec<u32>),
    /// Tick 0 stood for [`GATHER_NS`]; these members never came.
    GatheringFailed(Vec<u32>),
    /// These members have not granted the present tick.
    Granting(Vec<u32>),
    /// All have granted; datagrams that the vehicle's link has counted are still under way.
    Datagrams,
    /// The speed limit: the next tick begins at this wall time.
    Until(u64),
    /// The next tick may begin now.
    Ready,
}

#[derive(Debug, Clone, Default)]
struct Member {
    incarnation: u64,
    pid: u32,
    granted: Option<u64>,
    work: u64,
    datagrams: u64,
    seen: bool,
    is_in: bool,
    left: bool,
    left_at_ns: u64,
    held: bool,
    /// The process of this life has ended.
    gone: bool,
    outs: u32,
    moved_at_ns: u64,
}

impl Member {
    fn leave(&mut self, leaving: bool, wall_ns: u64) {
        if leaving && !core::mem::replace(&mut self.left, true) {
            self.left_at_ns = wall_ns;
        }
    }

    fn waited_for(&self) -> bool {
        self.is_in && !self.left
    }
}

/// The clock of a lockstep simulation.
#[derive(Debug, Clone)]
pub struct Lockstep {
    incarnation: u64,
    members: BTreeMap<u32, Member>,
    /// Whose datagrams are counted.
    link: u32,
    tick: u64,
    speed: f64,
    started_ns: u64,
    tick_at_ns: u64,
    granted_at_ns: Option<u64>,
    sent_at_ns: u64,
    /// The link's datagrams read before its present life, less what was given up since.
    datagram_base: i64,
    lost_datagrams: u64,
    foreign: bool,
    ever_out: bool,
    /// A member has left just now.
    just_left: bool,
}

impl Lockstep {
    /// A clock at tick 0 for members by their service codes; `link` is the one whose datagrams are counted. `speed` is
    /// simulated seconds per wall second at most, 0 for no limit.
    #[must_use]
    pub fn new(incarnation: u64, members: &[u32], link: u32, speed: f64, wall_ns: u64) -> Self {
        Self {
            incarnation,
            members: members.iter().map(|&code| (code, Member::default())).collect(),
            link,
            tick: 0,
            speed: if speed.is_finite() { speed.max(0.0) } else { 0.0 },
            started_ns: wall_ns,
            tick_at_ns: wall_ns,
            granted_at_ns: None,
            sent_at_ns: 0,
            datagram_base: 0,
            lost_datagrams: 0,
            foreign: false,
            ever_out: false,
            just_left: false,
        }
    }

    /// The present tick.
    #[must_use]
    pub fn tick(&self) -> u64 {
        self.tick
    }

    /// Bit s is set while the member with code s is in.
    #[must_use]
    pub fn members_in(&self) -> u64 {
        self.members.iter().filter(|(_, m)| m.waited_for()).fold(0, |bits, (&code, _)| bits | 1 << code.min(63))
    }

    /// How often each member was found out, by code.
    pub fn outs(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        self.members.iter().map(|(&code, m)| (code, m.outs))
    }

    /// Processes to watch: (code, incarnation, pid) of the members that live and have not left, whether in or out.
    pub fn processes(&self) -> impl Iterator<Item = (u32, u64, u32)> + '_ {
        self.members.iter().filter(|(_, m)| m.seen && !m.left && !m.gone).map(|(&code, m)| (code, m.incarnation, m.pid))
    }

    /// Whether the vehicle's link died and has not come back: nobody steers the vehicle, unless a foreign client does.
    #[must_use]
    pub fn link_died(&self) -> bool {
        self.members.get(&self.link).is_some_and(|link| link.gone && !link.left) && !self.foreign
    }

    /// Datagrams that never came.
    #[must_use]
    pub fn lost_datagrams(&self) -> u64 {
        self.lost_datagrams
    }

    /// Whether a run like this repeats bit for bit: no out, no lost datagram, no foreign client.
    #[must_use]
    pub fn deterministic(&self) -> bool {
        !self.ever_out && !self.foreign && self.lost_datagrams == 0
    }

    /// A client that is no member has sent to the vehicle: time runs at real time at most from now on. True the first
    /// time.
    pub fn on_foreign(&mut self) -> bool {
        !core::mem::replace(&mut self.foreign, true)
    }

    /// A grant came. `read` is how many datagrams of the link have been read so far.
    pub fn on_grant(&mut self, grant: &Grant, read: u64, wall_ns: u64) {
        if grant.clock_incarnation != self.incarnation {
            return;
        }
        let tick = self.tick;
        let Some(member) = self.members.get_mut(&grant.service) else { return };
        if grant.incarnation < member.incarnation {
            return;
        }
        if grant.incarnation > member.incarnation {
            let restarted = member.seen;
            if restarted && member.waited_for() {
                member.outs += 1;
                self.ever_out = true;
            }
            *member = Member {
                incarnation: grant.incarnation,
                pid: grant.pid,
                seen: true,
                outs: member.outs,
                moved_at_ns: wall_ns,
                ..Member::default()
            };
            if restarted && grant.service == self.link {
                self.datagram_base = read.cast_signed() - grant.datagrams.cast_signed();
            }
        }
        if member.gone {
            // Its last words, read after its end was seen: all that they may still tell is that it meant to leave.
            member.leave(grant.leaving, wall_ns);
            return;
        }
        if member.granted != Some(grant.tick) || member.work != grant.work || member.held != grant.held {
            member.moved_at_ns = wall_ns;
        }
        member.work = grant.work;
        member.datagrams = grant.datagrams;
        member.held = grant.held;
        member.left &= grant.leaving;
        member.leave(grant.leaving, wall_ns);
        member.granted = Some(grant.tick);
        if grant.tick == tick {
            // Whoever was out and grants the present tick is in again.
            member.is_in = true;
        }
    }

    /// A member's process is gone.
    pub fn on_gone(&mut self, service: u32, incarnation: u64) {
        let Some(member) = self.members.get_mut(&service).filter(|m| m.incarnation == incarnation) else { return };
        member.gone = true;
        if member.waited_for() {
            member.is_in = false;
            member.outs += 1;
            self.ever_out = true;
        }
    }

    /// Finds members out whose tick and work stand still, and says what the clock waits for. `read` is how many
    /// datagrams of the link have been read.
    pub fn poll(&mut self, read: u64, wall_ns: u64) -> Phase {
        let tick = self.tick;
        if tick == 0 {
            let missing: Vec<u32> =
                self.members.iter().filter(|(_, m)| !m.left && m.granted != Some(0)).map(|(&code, _)| code).collect();
            if !missing.is_empty() {
                let late = wall_ns.saturating_sub(self.started_ns) >= GATHER_NS;
                return if late { Phase::GatheringFailed(missing) } else { Phase::Gathering(missing) };
            }
        }
        self.just_left = self.members.values().any(|m| m.left && wall_ns.saturating_sub(m.left_at_ns) < LEFT_NS);
        let mut waiting = Vec::new();
        for (&code, member) in &mut self.members {
            if !member.waited_for() || member.granted == Some(tick) {
                continue;
            }
            let still = wall_ns.saturating_sub(member.moved_at_ns.max(self.tick_at_ns));
            if still >= STILL_NS && !member.held {
                member.is_in = false;
                member.outs += 1;
                self.ever_out = true;
            } else {
                waiting.push(code);
            }
        }
        if !waiting.is_empty() {
            self.granted_at_ns = None;
            return Phase::Granting(waiting);
        }
        let granted_at = *self.granted_at_ns.get_or_insert(wall_ns);
        if self.datagrams_missing(read, granted_at, wall_ns) {
            return Phase::Datagrams;
        }
        match self.not_before() {
            Some(at) if wall_ns < at => Phase::Until(at),
            _ => Phase::Ready,
        }
    }

    fn datagrams_missing(&mut self, read: u64, granted_at_ns: u64, wall_ns: u64) -> bool {
        let Some(link) = self.members.get(&self.link).filter(|m| m.waited_for()) else { return false };
        let missing = self.datagram_base + link.datagrams.cast_signed() - read.cast_signed();
        if missing <= 0 {
            return false;
        }
        if wall_ns.saturating_sub(granted_at_ns) < DATAGRAM_NS {
            return true;
        }
        self.lost_datagrams += missing.unsigned_abs();
        self.datagram_base -= missing;
        false
    }

    /// Earliest wall time of the next tick; real time at most while a member is out or has just left, all have left, or a
    /// foreign client flies.
    fn not_before(&self) -> Option<u64> {
        let out = self.members.values().any(|m| !m.is_in && !m.left);
        let alone = !self.members.values().any(Member::waited_for);
        let speed = match (out || alone || self.just_left || self.foreign, self.speed) {
            (true, s) if s == 0.0 || s > 1.0 => 1.0,
            (_, s) => s,
        };
        (speed > 0.0).then(|| self.tick_at_ns + (TICK_NS / speed) as u64)
    }

    /// Begins the next tick.
    pub fn advance(&mut self, wall_ns: u64) {
        // A limited clock keeps its pace: the next tick counts from when this one should have begun.
        self.tick_at_ns = match self.not_before() {
            Some(at) if wall_ns.saturating_sub(at) < STILL_NS / 20 => at,
            _ => wall_ns,
        };
        self.tick += 1;
        self.granted_at_ns = None;
    }

    /// Whether the clock's state is to be sent: on a new tick, and every 100 ms. Remembers that it was.
    pub fn send_due(&mut self, fresh: bool, wall_ns: u64) -> bool {
        let due = fresh || wall_ns.saturating_sub(self.sent_at_ns) >= RESEND_NS;
        if due {
            self.sent_at_ns = wall_ns;
        }
        due
    }
}

#[cfg(test)]
mod tests;
