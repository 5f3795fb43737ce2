//! The simulator's camera: a client of `simulator/render`, which renders the true view of an instant in the world's
//! process. The bus keeps a request and sends it again while the world is away.

use std::collections::BTreeMap;

use shared_types::bus::Client;
use shared_types::channel::RenderChannel;
use shared_types::messages::{RenderPurpose, RenderReply, RenderRequest, RenderStatus};

use crate::source::{Delivery, Image, ImageRequest, RgbdSource, SourceError};

/// Client of the world's renderer.
#[derive(Debug)]
pub struct SimulatorSource {
    client: Client<RenderChannel>,
    pending: BTreeMap<u64, ImageRequest>,
}

impl SimulatorSource {
    /// A source over an opened client.
    #[must_use]
    pub fn new(client: Client<RenderChannel>) -> Self {
        Self { client, pending: BTreeMap::new() }
    }
}

impl RgbdSource for SimulatorSource {
    fn request(&mut self, now_ns: u64, request: &ImageRequest) -> Result<(), SourceError> {
        let camera = &request.intrinsics;
        let header = RenderRequest {
            image_stamp_ns: request.stamp_ns,
            focal_px: [camera.fx, camera.fy],
            principal_px: [camera.cx, camera.cy],
            width: camera.width,
            height: camera.height,
            purpose: request.purpose.code(),
            reserved: 0,
        };
        self.pending.insert(request.id, *request);
        self.client.send(now_ns, request.id, &header, &[])?;
        Ok(())
    }

    fn cancel(&mut self, id: u64) {
        self.pending.remove(&id);
        self.client.finish(id);
    }

    fn poll(&mut self, now_ns: u64, deliver: &mut dyn FnMut(Delivery<'_>)) -> Result<(), SourceError> {
        while let Some(reply) = self.client.receive(now_ns)? {
            let id = reply.request_id();
            self.client.finish(id);
            if let Some(request) = self.pending.remove(&id) {
                deliver(read(&request, reply.header(), reply.items()));
            }
        }
        Ok(())
    }
}

/// Checks a reply against its request: the world is another process and may be wild, or of another mind.
fn read<'a>(request: &ImageRequest, reply: &RenderReply, items: &'a [u8]) -> Delivery<'a> {
    let id = request.id;
    let refused = |reason: String| Delivery::Refused { id, reason };
    match RenderStatus::from_code(reply.status) {
        Some(RenderStatus::Done) => {}
        Some(RenderStatus::NoTruth) => return Delivery::Gone { id },
        Some(RenderStatus::Refused) => return refused("the world refused to render the view".to_owned()),
        None => return refused(format!("the world answered with the unknown status {}", reply.status)),
    }
    let camera = &request.intrinsics;
    let has_color = request.purpose != RenderPurpose::Depth;
    let wanted = (camera.width, camera.height, u32::from(has_color));
    if (reply.width, reply.height, reply.has_color) != wanted {
        let found = (reply.width, reply.height, reply.has_color);
        return refused(format!("the world rendered {found:?} (width, height, colour) where {wanted:?} was asked for"));
    }
    let bytes = camera.width as usize * camera.height as usize * if has_color { 5 } else { 2 };
    if items.len() != bytes {
        return refused(format!("the world sent {} bytes of image; expected {bytes}", items.len()));
    }
    if !(reply.depth_unit_m.is_finite() && reply.depth_unit_m > 0.0) {
        return refused(format!("the world's depth unit is {} m; expected above 0", reply.depth_unit_m));
    }
    let (stamp_ns, intrinsics) = (reply.image_stamp_ns, *camera);
    Delivery::Image(Image { id, stamp_ns, intrinsics, depth_unit_m: reply.depth_unit_m, has_color, items })
}

#[cfg(test)]
mod tests {
    use shared_types::frames::Intrinsics;

    use super::*;

    fn request(purpose: RenderPurpose) -> ImageRequest {
        ImageRequest { id: 3, purpose, stamp_ns: 70, intrinsics: Intrinsics::from_hfov(4, 2, 1.2) }
    }

    fn done() -> RenderReply {
        RenderReply {
            image_stamp_ns: 70,
            depth_unit_m: 0.001,
            status: RenderStatus::Done.code(),
            width: 4,
            height: 2,
            has_color: 1,
            ..RenderReply::default()
        }
    }

    #[test]
    fn a_wild_reply_is_refused_and_never_read() {
        let capture = request(RenderPurpose::Capture);
        assert!(matches!(read(&capture, &done(), &[0; 40]), Delivery::Image(image) if image.items.len() == 40));
        let wild = [
            (RenderReply { width: 5, ..done() }, 40),
            (RenderReply { has_color: 0, ..done() }, 16),
            (done(), 39),
            (RenderReply { depth_unit_m: f64::NAN, ..done() }, 40),
            (RenderReply { status: 77, ..done() }, 40),
        ];
        for (reply, bytes) in wild {
            let items = vec![0; bytes];
            assert!(matches!(read(&capture, &reply, &items), Delivery::Refused { id: 3, .. }), "{reply:?}");
        }
        let gone = RenderReply { status: RenderStatus::NoTruth.code(), ..done() };
        assert!(matches!(read(&capture, &gone, &[]), Delivery::Gone { id: 3 }));
    }

    #[test]
    fn depth_comes_without_colour() {
        let depth = RenderReply { has_color: 0, ..done() };
        assert!(
            matches!(read(&request(RenderPurpose::Depth), &depth, &[0; 16]), Delivery::Image(image) if !image.has_color)
        );
    }
}
