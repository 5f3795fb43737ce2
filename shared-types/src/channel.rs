//! The one table of channels: name, types, and settings of each.
//!
//! The first process that opens a channel fixes its settings, so every process must ask for the same: they come from here
//! alone. Safe overflow everywhere: a full queue loses its oldest message, and no sender ever waits for a reader.

use crate::Payload;
use crate::bus::Envelope;
use crate::messages::{
    Alive, CandidateScore, CandidateState, CandidateView, CaptureReply, CaptureRequest, Check, ClockGrant, ClockTick,
    CommandReply, CommandRequest, ControlReply, ControlRequest, FrameHeader, GaussianRow, Health, MissionReply,
    MissionRequest, MissionState, RenderReply, RenderRequest, RoundReply, RoundRequest, ScoreReply, ScoreRequest,
    SnapshotHeader, Truth, VehicleState, VehicleTarget, Waypoint,
};

/// Most items that a message may carry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ItemLimit {
    /// A number known at compile time.
    Fixed(usize),
    /// Bytes of one full-size RGB-D image.
    Image,
    /// Bytes of one small depth image.
    SmallDepth,
    /// `model.max_gaussians`.
    Gaussians,
}

/// Settings of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Settings {
    /// Messages kept for each reader; in lockstep at least two ticks' traffic.
    pub queue: usize,
    /// Messages kept for readers that come late.
    pub history: usize,
    /// Most items in a message.
    pub items: ItemLimit,
    /// Chunks reserved for each publisher; `None`: the worst case of all readers, for small messages.
    pub chunks: Option<usize>,
    /// Processes that send on it in a mission: how much shared memory it takes in all.
    pub senders: usize,
    /// Whether a message wakes its readers.
    pub wakes: bool,
    /// Whether readers in lockstep see only what was sent before the present tick.
    pub by_tick: bool,
}

impl Settings {
    const SMALL: Self = Self {
        queue: 16,
        history: 0,
        items: ItemLimit::Fixed(1),
        chunks: None,
        senders: 1,
        wakes: false,
        by_tick: true,
    };
    const STATE: Self = Self { queue: 4, history: 1, ..Self::SMALL };
}

/// Readers, writers and processes that a channel admits: all services, tools that look in, and head-room for those that
/// died and have not been cleaned up.
pub const MAX_SUBSCRIBERS: usize = 12;
/// See [`MAX_SUBSCRIBERS`].
pub const MAX_PUBLISHERS: usize = 16;
/// See [`MAX_SUBSCRIBERS`].
pub const MAX_NODES: usize = 32;

/// A channel: a header and a slice of items in every message.
pub trait Channel: 'static {
    /// Name on the bus.
    const NAME: &'static str;
    /// Settings, from the table in this file.
    const SETTINGS: Settings;
    /// The part of fixed size, which knows what it and the items must be.
    type Header: Payload + Default + Check<Self::Item>;
    /// What the slice is made of.
    type Item: Payload;

    /// Hash over both types and the envelope around them, published as the service's attribute.
    const SCHEMA: u64 = crate::payload::fold(
        crate::payload::fold(<Envelope as Payload>::SCHEMA, <Self::Header as Payload>::SCHEMA),
        <Self::Item as Payload>::SCHEMA,
    );
}

/// A channel with an answer: a pair of channels, `<name>/request` and `<name>/reply`. Replies may stream, a server that
/// comes late gets the request again, and a recorder sees both like any other channel.
pub trait RequestChannel: 'static {
    /// Where requests go.
    type Request: Channel;
    /// Where replies come from.
    type Reply: Channel;
}

/// Every channel of the table, for those that open all of them (the keeper, a recorder, `status`).
pub trait ChannelVisitor {
    /// Called once for each channel.
    fn visit<C: Channel>(&mut self);
}

macro_rules! channels {
    ($( $(#[$doc:meta])* $marker:ident = $name:literal, $header:ty, $item:ty, $settings:expr; )*) => {
        $(
            $(#[$doc])*
            #[derive(Debug)]
            pub struct $marker;

            impl Channel for $marker {
                const NAME: &'static str = $name;
                const SETTINGS: Settings = $settings;
                type Header = $header;
                type Item = $item;
            }
        )*

        /// Visits every channel of the table, in its order.
        pub fn visit_all(visitor: &mut impl ChannelVisitor) {
            $( visitor.visit::<$marker>(); )*
        }

        /// Names of every channel, in the table's order.
        pub const NAMES: &[&str] = &[$( $name ),*];
    };
}

macro_rules! requests {
    ($( $(#[$doc:meta])* $marker:ident = $request:ty, $reply:ty; )*) => { $(
        $(#[$doc])*
        #[derive(Debug)]
        pub struct $marker;

        impl RequestChannel for $marker {
            type Request = $request;
            type Reply = $reply;
        }
    )* };
}

channels! {
    /// px4-link tells what the vehicle does; the camera interpolates between states.
    VehicleStateChannel = "vehicle/state", VehicleState, u8, Settings { queue: 64, ..Settings::SMALL };
    /// The planner's path. No history: a late joiner must not fly an old path.
    VehicleTargetChannel = "vehicle/target", VehicleTarget, Waypoint,
        Settings { items: ItemLimit::Fixed(256), queue: 8, ..Settings::SMALL };
    /// Half of [`VehicleCommandChannel`].
    VehicleCommandRequests = "vehicle/command/request", CommandRequest, u8, Settings { senders: 2, ..Settings::SMALL };
    /// Half of [`VehicleCommandChannel`].
    VehicleCommandReplies = "vehicle/command/reply", CommandReply, u8, Settings::SMALL;
    /// The planner's heartbeat.
    AliveChannel = "planner/alive", Alive, u8, Settings::SMALL;
    /// Half of [`MissionCommandChannel`].
    MissionCommandRequests = "mission/command/request", MissionRequest, u8, Settings { senders: 3, ..Settings::SMALL };
    /// Half of [`MissionCommandChannel`].
    MissionCommandReplies = "mission/command/reply", MissionReply, u8, Settings::SMALL;
    /// What the mission does.
    MissionStateChannel = "mission/state", MissionState, CandidateState,
        Settings { items: ItemLimit::Fixed(512), ..Settings::STATE };
    /// The camera's stream, never copied.
    FrameChannel = "camera/frame", FrameHeader, u8,
        Settings { queue: 2, items: ItemLimit::Image, chunks: Some(8), wakes: true, ..Settings::SMALL };
    /// Small depth images for the planner.
    DepthChannel = "camera/depth", FrameHeader, u8,
        Settings { queue: 4, items: ItemLimit::SmallDepth, chunks: Some(24), ..Settings::SMALL };
    /// Half of [`CaptureChannel`].
    CaptureRequests = "camera/capture/request", CaptureRequest, u8, Settings::SMALL;
    /// Half of [`CaptureChannel`].
    CaptureReplies = "camera/capture/reply", CaptureReply, u8, Settings::SMALL;
    /// Keyframes; a wake-up and a picture: the mission folder decides.
    KeyframeChannel = "camera/keyframe", FrameHeader, u8,
        Settings { queue: 4, items: ItemLimit::Image, chunks: Some(12), ..Settings::SMALL };
    /// Half of [`RoundChannel`].
    RoundRequests = "trainer/round/request", RoundRequest, u64,
        Settings { items: ItemLimit::Fixed(1024), queue: 4, chunks: Some(16), ..Settings::SMALL };
    /// Half of [`RoundChannel`].
    RoundReplies = "trainer/round/reply", RoundReply, u8, Settings::SMALL;
    /// The model. Few chunks, since each is large; a live snapshot without a free chunk is skipped and counted.
    SnapshotChannel = "model/snapshot", SnapshotHeader, GaussianRow,
        Settings { queue: 1, history: 1, items: ItemLimit::Gaussians, chunks: Some(6), ..Settings::SMALL };
    /// Half of [`ScoreChannel`]. Few chunks, since each is large: the other end's queue and what it reads, twice over for a
    /// recorder and a tool that look in.
    ScoreRequests = "scorer/score/request", ScoreRequest, CandidateView,
        Settings { items: ItemLimit::Fixed(2048), queue: 4, chunks: Some(16), ..Settings::SMALL };
    /// Half of [`ScoreChannel`].
    ScoreReplies = "scorer/score/reply", ScoreReply, CandidateScore,
        Settings { items: ItemLimit::Fixed(2048), queue: 4, chunks: Some(16), ..Settings::SMALL };
    /// Health of every service, once a second.
    HealthChannel = "health", Health, u8, Settings { queue: 32, senders: 8, by_tick: false, ..Settings::SMALL };
    /// The keeper's memory: the last health of every service, one item each, dead ones included.
    HealthLastChannel = "health/last", Health, Health,
        Settings { items: ItemLimit::Fixed(16), by_tick: false, ..Settings::STATE };
    /// Half of [`ControlChannel`].
    ControlRequests = "control/request", ControlRequest, u8, Settings { by_tick: false, ..Settings::SMALL };
    /// Half of [`ControlChannel`].
    ControlReplies = "control/reply", ControlReply, u8, Settings { senders: 8, by_tick: false, ..Settings::SMALL };
    /// The true pose, for the world and for evaluation.
    TruthChannel = "simulator/truth", Truth, u8, Settings { queue: 512, chunks: Some(4096), by_tick: false, ..Settings::SMALL };
    /// Half of [`RenderChannel`].
    RenderRequests = "simulator/render/request", RenderRequest, u8,
        Settings { queue: 4, wakes: true, by_tick: false, ..Settings::SMALL };
    /// Half of [`RenderChannel`].
    RenderReplies = "simulator/render/reply", RenderReply, u8,
        Settings { queue: 4, items: ItemLimit::Image, chunks: Some(8), wakes: true, by_tick: false, ..Settings::SMALL };
    /// The mission clock.
    ClockChannel = "clock", ClockTick, u8, Settings { wakes: true, by_tick: false, ..Settings::STATE };
    /// Grants of its members.
    GrantChannel = "clock/grant", ClockGrant, u8, Settings { queue: 64, senders: 5, wakes: true, by_tick: false, ..Settings::SMALL };
}

requests! {
    /// Take control, arm, take off, hold, return, land.
    VehicleCommandChannel = VehicleCommandRequests, VehicleCommandReplies;
    /// Start, stop, abort, land, go on.
    MissionCommandChannel = MissionCommandRequests, MissionCommandReplies;
    /// Take a keyframe.
    CaptureChannel = CaptureRequests, CaptureReplies;
    /// Run a training round.
    RoundChannel = RoundRequests, RoundReplies;
    /// Score candidates.
    ScoreChannel = ScoreRequests, ScoreReplies;
    /// Render the world; answered inside a tick.
    RenderChannel = RenderRequests, RenderReplies;
    /// Stop, log level, debugger.
    ControlChannel = ControlRequests, ControlReplies;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_short_enough_for_socket_paths() {
        let mut names = NAMES.to_vec();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), NAMES.len());
        assert!(names.iter().all(|name| name.len() <= 40));
    }

    #[test]
    fn a_late_joiner_never_gets_an_old_path() {
        assert_eq!(VehicleTargetChannel::SETTINGS.history, 0);
    }
}
