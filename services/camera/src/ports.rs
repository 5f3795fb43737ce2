//! Every channel of the camera.

use shared_types::bus::{Bus, BusError, Client, Publisher, ReplyAddress, Server, Subscriber};
use shared_types::channel::{
    CaptureChannel, DepthChannel, FrameChannel, KeyframeChannel, MissionStateChannel, RenderChannel,
    VehicleStateChannel,
};
use shared_types::folder::Keyframe;
use shared_types::messages::{CaptureReply, CaptureRequest, FrameHeader, MissionState, VehicleState};

/// The camera's ends of its channels.
#[derive(Debug)]
pub struct Ports {
    states: Subscriber<VehicleStateChannel>,
    missions: Subscriber<MissionStateChannel>,
    captures: Server<CaptureChannel>,
    frames: Publisher<FrameChannel>,
    depths: Publisher<DepthChannel>,
    keyframes: Publisher<KeyframeChannel>,
    replies: u64,
    dropped: u64,
}

impl Ports {
    /// Opens every channel; the client of the renderer goes to the simulator's source.
    ///
    /// # Errors
    /// When a channel cannot be opened.
    pub fn open(bus: &Bus) -> Result<(Self, Client<RenderChannel>), BusError> {
        let ports = Self {
            states: bus.subscriber()?,
            missions: bus.subscriber()?,
            captures: bus.server()?,
            frames: bus.publisher()?,
            depths: bus.publisher()?,
            keyframes: bus.publisher()?,
            replies: 0,
            dropped: 0,
        };
        Ok((ports, bus.client()?))
    }

    /// The next state of the vehicle.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn next_state(&mut self, now_ns: u64) -> Result<Option<VehicleState>, BusError> {
        Ok(self.states.receive(now_ns)?.map(|message| *message.header()))
    }

    /// The newest state of the mission, if it has changed.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn mission(&mut self, now_ns: u64) -> Result<Option<MissionState>, BusError> {
        Ok(self.missions.latest(now_ns)?.map(|message| *message.header()))
    }

    /// The next request for a keyframe.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn next_request(&mut self, now_ns: u64) -> Result<Option<(CaptureRequest, ReplyAddress)>, BusError> {
        Ok(self.captures.receive(now_ns)?.map(|message| (*message.header(), message.address())))
    }

    /// Answers a request for a keyframe.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn reply(&mut self, now_ns: u64, to: &ReplyAddress, reply: &CaptureReply) -> Result<(), BusError> {
        self.replies += 1;
        let sent = self.captures.reply(now_ns, to, reply, &[]);
        self.counting_dropped(sent)
    }

    /// Whether anybody reads the stream: what nobody looks at is not rendered.
    #[must_use]
    pub fn stream_wanted(&self) -> bool {
        self.frames.readers() > 0
    }

    /// Publishes an image of the stream: one copy, from the source's memory to the readers'.
    ///
    /// # Errors
    /// When the channel is broken. Readers that hold every chunk only cost the image.
    pub fn send_frame(
        &mut self,
        now_ns: u64,
        stamp_ns: u64,
        header: &FrameHeader,
        items: &[u8],
    ) -> Result<(), BusError> {
        let sent = self.frames.send_items(now_ns, stamp_ns, header, items);
        self.counting_dropped(sent)
    }

    /// Publishes a small depth image.
    ///
    /// # Errors
    /// As [`Self::send_frame`].
    pub fn send_depth(
        &mut self,
        now_ns: u64,
        stamp_ns: u64,
        header: &FrameHeader,
        items: &[u8],
    ) -> Result<(), BusError> {
        let sent = self.depths.send_items(now_ns, stamp_ns, header, items);
        self.counting_dropped(sent)
    }

    /// Publishes a keyframe that is on the disk.
    ///
    /// # Errors
    /// As [`Self::send_frame`].
    pub fn send_keyframe(&mut self, now_ns: u64, keyframe: &Keyframe) -> Result<(), BusError> {
        let header = keyframe.frame.header();
        let fill = |items: &mut [u8]| keyframe.fill_items(items);
        let sent = self.keyframes.send_with(now_ns, keyframe.frame.stamp_ns, &header, header.items_len(), fill);
        self.counting_dropped(sent)
    }

    /// Messages received so far.
    #[must_use]
    pub fn received(&self) -> u64 {
        self.states.received() + self.missions.received()
    }

    /// Messages sent so far.
    #[must_use]
    pub fn sent(&self) -> u64 {
        self.frames.sent() + self.depths.sent() + self.keyframes.sent() + self.replies
    }

    /// Messages lost so far, on the way here or for want of a free chunk.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped + self.states.lost()
    }

    fn counting_dropped(&mut self, sent: Result<(), BusError>) -> Result<(), BusError> {
        match sent {
            Err(BusError::NoChunk { channel }) => {
                tracing::debug!(channel, "readers hold every chunk; the message is dropped");
                self.dropped += 1;
                Ok(())
            }
            other => other,
        }
    }
}
