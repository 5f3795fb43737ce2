//! All of the world's IPC: the simulator's truth in, render requests in, images out.

use glam::{DQuat, DVec3};
use shared_types::bus::{Bus, BusError, Listener, ReplyAddress, Server, Subscriber};
use shared_types::channel::{RenderChannel, RenderRequests, TruthChannel};
use shared_types::frames::Pose;
use shared_types::messages::{RenderReply, RenderRequest, RenderStatus};

use crate::render::RgbdImage;

pub(crate) struct Ports {
    truth: Subscriber<TruthChannel>,
    requests: Server<RenderChannel>,
    wakes: Listener,
}

impl Ports {
    /// Opens the world's ends of its channels.
    pub(crate) fn open(bus: &Bus) -> Result<Self, BusError> {
        Ok(Self { truth: bus.subscriber()?, requests: bus.server()?, wakes: bus.listener::<RenderRequests>()? })
    }

    /// Is woken by requests.
    pub(crate) fn wakes(&self) -> &Listener {
        &self.wakes
    }

    /// The next true camera pose and its stamp.
    pub(crate) fn receive_truth(&mut self, now_ns: u64) -> Result<Option<(u64, Pose)>, BusError> {
        Ok(self.truth.receive(now_ns)?.map(|message| {
            let truth = message.header();
            let rotation = DQuat::from_array(truth.world_from_camera_xyzw);
            (truth.now_ns, Pose { position_m: DVec3::from_array(truth.camera_position_m), rotation })
        }))
    }

    /// The next request, and where its answer goes.
    pub(crate) fn receive_request(&mut self, now_ns: u64) -> Result<Option<(ReplyAddress, RenderRequest)>, BusError> {
        Ok(self.requests.receive(now_ns)?.map(|message| (message.address(), *message.header())))
    }

    /// Says why there is no image.
    pub(crate) fn reply_without_image(
        &mut self,
        now_ns: u64,
        to: &ReplyAddress,
        request: &RenderRequest,
        status: RenderStatus,
    ) -> Result<(), BusError> {
        let header =
            RenderReply { image_stamp_ns: request.image_stamp_ns, status: status.code(), ..RenderReply::default() };
        self.requests.reply(now_ns, to, &header, &[])
    }

    /// Sends an image, written straight into shared memory: colour (where `header` has it), then depth.
    pub(crate) fn reply_with_image(
        &mut self,
        now_ns: u64,
        to: &ReplyAddress,
        header: &RenderReply,
        image: &RgbdImage,
    ) -> Result<(), BusError> {
        let color = if header.has_color == 1 { &image.rgb[..] } else { &[] };
        let depth = image.depth_u16(header.depth_unit_m as f32);
        self.requests.reply_with(now_ns, to, header, color.len() + 2 * depth.len(), |items| {
            let (rgb, rest) = items.split_at_mut(color.len());
            rgb.copy_from_slice(color);
            for (bytes, code) in rest.as_chunks_mut::<2>().0.iter_mut().zip(&depth) {
                *bytes = code.to_le_bytes();
            }
        })
    }

    /// Requests and truths received so far, and truths lost.
    pub(crate) fn counts(&self) -> (u64, u64) {
        (self.truth.received(), self.truth.lost())
    }
}
