//! Images as `sensor_msgs/msg/Image` of ROS 2, in its wire format (CDR, OMG DDSI-RTPS 10.2, little-endian), which viewers of
//! MCAP files show.

use shared_types::messages::{FrameHeader, FrameView};

/// Schema name of the message.
pub(crate) const SCHEMA: &str = "sensor_msgs/msg/Image";
/// The message's definition, with those that it uses.
pub(crate) const DEFINITION: &str = "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n\
    uint8 is_bigendian\nuint32 step\nuint8[] data\n\
    ================================================================================\n\
    MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n\
    ================================================================================\n\
    MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";

/// CDR's rules: every number at a multiple of its size, counted from behind the four bytes that name the encoding.
#[derive(Debug)]
struct Cdr(Vec<u8>);

impl Cdr {
    fn new(capacity: usize) -> Self {
        let mut bytes = Vec::with_capacity(capacity);
        bytes.extend_from_slice(&[0, 1, 0, 0]);
        Self(bytes)
    }

    fn u32(&mut self, value: u32) {
        while !self.0.len().is_multiple_of(4) {
            self.0.push(0);
        }
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    fn bytes(&mut self, bytes: &[u8]) {
        self.u32(u32::try_from(bytes.len()).unwrap_or(u32::MAX));
        self.0.extend_from_slice(bytes);
    }

    fn text(&mut self, text: &str) {
        // The length counts the zero at the end.
        self.u32(u32::try_from(text.len() + 1).unwrap_or(u32::MAX));
        self.0.extend_from_slice(text.as_bytes());
        self.0.push(0);
    }
}

fn image(stamp_ns: u64, header: &FrameHeader, encoding: &str, pixel_bytes: u32, data: &[u8]) -> Vec<u8> {
    let mut cdr = Cdr::new(data.len() + 96);
    cdr.u32(u32::try_from(stamp_ns / 1_000_000_000).unwrap_or(u32::MAX));
    cdr.u32(u32::try_from(stamp_ns % 1_000_000_000).unwrap_or(0));
    cdr.text("camera");
    cdr.u32(header.height);
    cdr.u32(header.width);
    cdr.text(encoding);
    cdr.0.push(0);
    cdr.u32(header.width * pixel_bytes);
    cdr.bytes(data);
    cdr.0
}

/// The colour of a frame (`rgb8`); `None` where it has none.
pub(crate) fn color(stamp_ns: u64, view: &FrameView<'_>) -> Option<Vec<u8>> {
    (!view.rgb.is_empty()).then(|| image(stamp_ns, view.header, "rgb8", 3, view.rgb))
}

/// The depth of a frame (`16UC1`, in units of its header's `depth_unit_m`).
pub(crate) fn depth(stamp_ns: u64, view: &FrameView<'_>) -> Vec<u8> {
    let units: Vec<u8> = view.depth_units_vec().into_iter().flat_map(u16::to_le_bytes).collect();
    image(stamp_ns, view.header, "16UC1", 2, &units)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand, after the rules of CDR.
    #[test]
    fn an_image_is_laid_out_as_cdr_wants_it() {
        let header = FrameHeader { width: 2, height: 1, ..FrameHeader::default() };
        let bytes = image(3_000_000_007, &header, "rgb8", 3, &[1, 2, 3, 4, 5, 6]);
        let expected: Vec<u8> = [
            &[0, 1, 0, 0][..],
            &[3, 0, 0, 0],
            &[7, 0, 0, 0],
            &[7, 0, 0, 0],
            b"camera\0",
            &[0],
            &[1, 0, 0, 0],
            &[2, 0, 0, 0],
            &[5, 0, 0, 0],
            b"rgb8\0",
            &[0],
            &[0, 0],
            &[6, 0, 0, 0],
            &[6, 0, 0, 0],
            &[1, 2, 3, 4, 5, 6],
        ]
        .concat();
        assert_eq!(bytes, expected);
    }
}
