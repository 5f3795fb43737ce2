//! Hand-over of a frame from the camera to a reader: no copy, so the time does not grow with the size.
//!
//! `cargo bench -p shared-types --bench handover` prints, for growing images, the median time from `send` to the reader
//! holding the bytes, and beside it the time of one copy of the same bytes: the floor that a copying bus could not beat.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "a test or bench fails by panicking")]

use std::hint::black_box;
use std::time::Instant;

use shared_types::ServiceName;
use shared_types::bus::{Bus, Limits};
use shared_types::channel::FrameChannel;
use shared_types::messages::FrameHeader;
use shared_types::system::System;

const ROUNDS: usize = 400;

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

fn main() {
    let base = std::path::Path::new("/dev/shm");
    let system = System::create(base, "vantage-bench", 0).expect("a system in /dev/shm");
    let limits = Limits { image_bytes: 1920 * 1440 * 5, small_depth_bytes: 1, gaussians: 1 };
    let join = |name| Bus::open(&system, limits, name, 1, false).expect("joined");
    let (camera, reader) = (join(ServiceName::Camera), join(ServiceName::Command));
    let mut frames = camera.publisher::<FrameChannel>().expect("publisher");
    let mut subscriber = reader.subscriber::<FrameChannel>().expect("subscriber");
    println!("{:>11} {:>10} {:>14} {:>12}", "image", "bytes", "hand-over us", "one copy us");
    for (width, height) in [(160, 120), (320, 240), (640, 480), (1280, 960), (1920, 1440)] {
        let header = FrameHeader { width, height, has_color: 1, ..FrameHeader::default() };
        let len = header.items_len();
        let (mut handed, mut copied) = (Vec::new(), Vec::new());
        let source = vec![7_u8; len];
        let mut sink = vec![0_u8; len];
        for round in 0..ROUNDS {
            let mut filled = Instant::now();
            frames
                .send_with(1, 1, &header, len, |bytes| {
                    bytes[len - 1] = (round % 251) as u8;
                    filled = Instant::now();
                })
                .expect("sent");
            let frame = subscriber.receive(2).expect("received").expect("a frame");
            handed.push(filled.elapsed().as_secs_f64() * 1e6);
            assert_eq!(frame.items()[len - 1], (round % 251) as u8);
            let before = Instant::now();
            sink.copy_from_slice(black_box(&source));
            black_box(&mut sink);
            copied.push(before.elapsed().as_secs_f64() * 1e6);
        }
        println!("{:>11} {len:>10} {:>14.1} {:>12.1}", format!("{width}x{height}"), median(handed), median(copied));
    }
    drop((frames, subscriber, camera, reader));
    system.remove().expect("removed");
}
