//! The state machine, event by event.

use std::collections::BTreeMap;

use proptest::prelude::*;
use shared_types::config::CameraConfig;
use shared_types::frames::Pose;

use super::*;
use crate::logic::gate::Stillness;
use crate::logic::pose_buffer::CameraMotion;

const MS: u64 = 1_000_000;

fn captures() -> Captures {
    Captures::new(Limits::of(&CameraConfig::default()))
}

fn request(keyframe_id: u64) -> CaptureRequest {
    CaptureRequest {
        keyframe_id,
        target_id: keyframe_id,
        reason: KeyframeReason::Seed.code(),
        ..CaptureRequest::default()
    }
}

fn from(request_id: u64) -> ReplyAddress {
    ReplyAddress { client: 8, client_incarnation: 0, request_id, sent_ns: 0 }
}

fn still(ms: u64) -> Shot {
    let motion = CameraMotion { world_from_camera: Pose::IDENTITY, speed_mps: 0.0, rate_radps: 0.0 };
    let still = Stillness::of(&CameraConfig::default(), &motion, 1.0, 0.0);
    Shot { stamp_ns: ms * MS, motion, still, gate_missed: false }
}

fn ask(captures: &mut Captures, request_id: u64, request: CaptureRequest) -> Vec<Effect> {
    captures.on(Event::Asked { request, from: from(request_id), stored: None })
}

fn replies(effects: &[Effect]) -> Vec<(u64, CaptureStatus)> {
    let status = |reply: &CaptureReply| CaptureStatus::from_code(reply.status).expect("a status");
    effects
        .iter()
        .filter_map(|effect| match effect {
            Effect::Reply(to, reply) => Some((to.request_id, status(reply))),
            _ => None,
        })
        .collect()
}

#[test]
fn a_capture_goes_from_the_arrival_to_the_disk_to_the_answer() {
    let mut captures = captures();
    assert!(ask(&mut captures, 1, request(7)).is_empty());
    assert!(captures.on(Event::Arrived { target_id: 6, stamp_ns: 10 * MS }).is_empty());
    assert!(matches!(captures.state(), Capture::WaitingForArrival { .. }), "another target's end");
    captures.on(Event::Arrived { target_id: 7, stamp_ns: 10 * MS });
    captures.on(Event::Instant(still(20)));
    assert_eq!(captures.on(Event::Time(30 * MS)), [Effect::Render(still(20))]);
    assert_eq!(captures.on(Event::Image(still(20))), [Effect::Store]);
    let effects = captures.on(Event::Stored(Ok(())));
    assert_eq!(effects.first(), Some(&Effect::Publish), "published before it is answered");
    assert_eq!(replies(&effects), [(1, CaptureStatus::Stored)]);
    assert_eq!(captures.state(), &Capture::Idle);
}

#[test]
fn an_instant_that_is_gone_opens_the_gate_again() {
    let mut captures = captures();
    ask(&mut captures, 1, request(7));
    captures.on(Event::Arrived { target_id: 7, stamp_ns: 10 * MS });
    captures.on(Event::Instant(still(20)));
    captures.on(Event::Time(30 * MS));
    captures.on(Event::ImageGone { now_ns: 500 * MS });
    captures.on(Event::Instant(still(490)));
    assert!(captures.on(Event::Time(510 * MS)).is_empty(), "from before the gate was opened again");
    captures.on(Event::Instant(still(520)));
    assert_eq!(captures.on(Event::Time(530 * MS)), [Effect::Render(still(520))]);
}

#[test]
fn another_keyframe_takes_the_place_of_one_not_yet_stored() {
    let mut captures = captures();
    ask(&mut captures, 1, request(7));
    assert_eq!(replies(&ask(&mut captures, 2, request(8))), [(1, CaptureStatus::Failed)]);
    captures.on(Event::Arrived { target_id: 8, stamp_ns: 10 * MS });
    captures.on(Event::Instant(still(20)));
    captures.on(Event::Time(30 * MS));
    captures.on(Event::Image(still(20)));
    assert!(ask(&mut captures, 3, request(9)).is_empty(), "the one being stored is finished first");
    assert_eq!(replies(&captures.on(Event::Stored(Ok(())))), [(2, CaptureStatus::Stored)]);
    assert!(matches!(captures.state(), Capture::WaitingForArrival { job } if job.request.keyframe_id == 9));
}

#[test]
fn a_planner_that_was_restarted_joins_by_its_new_target() {
    let mut captures = captures();
    ask(&mut captures, 1, request(7));
    captures.on(Event::Arrived { target_id: 7, stamp_ns: 10 * MS });
    ask(&mut captures, 2, CaptureRequest { target_id: 70, ..request(7) });
    assert!(matches!(captures.state(), Capture::WaitingForArrival { job } if job.askers.len() == 2));
    let other = CaptureRequest { look_at_m: [1.0; 3], ..request(7) };
    assert_eq!(replies(&ask(&mut captures, 3, other)), [(3, CaptureStatus::Refused)]);
}

#[test]
fn a_full_disk_is_told_and_the_camera_goes_on() {
    let mut captures = captures();
    ask(&mut captures, 1, CaptureRequest { target_id: 0, ..request(7) });
    captures.on(Event::Arrived { target_id: 0, stamp_ns: 10 * MS });
    captures.on(Event::Instant(still(20)));
    captures.on(Event::Time(30 * MS));
    captures.on(Event::Image(still(20)));
    let effects = captures.on(Event::Stored(Err("no room for keyframes/000007/rgb.png".to_owned())));
    assert_eq!(replies(&effects), [(1, CaptureStatus::Failed)]);
    assert!(!effects.contains(&Effect::Publish));
    assert!(ask(&mut captures, 2, request(8)).is_empty());
}

#[test]
fn a_frame_of_the_stream_is_no_keyframe() {
    for reason in [KeyframeReason::Stream.code(), 99] {
        let wild = CaptureRequest { reason, ..request(7) };
        assert_eq!(replies(&ask(&mut captures(), 1, wild)), [(1, CaptureStatus::Refused)]);
    }
}

proptest! {
    #[test]
    fn whatever_happens_each_request_gets_one_answer_and_each_image_is_stored_once(
        events in prop::collection::vec((0..9u8, 1..5u64), 1..120),
    ) {
        let mut captures = captures();
        let mut answers: BTreeMap<u64, usize> = BTreeMap::new();
        let mut asked = 0;
        let (mut images, mut stores) = (0, 0);
        for (step, (kind, id)) in (1..).zip(events) {
            let now = step * 20;
            let rendering = matches!(captures.state(), Capture::Rendering { .. });
            let storing = matches!(captures.state(), Capture::Storing { .. });
            let effects = match kind {
                0 | 1 => {
                    asked += 1;
                    ask(&mut captures, asked, CaptureRequest { deadline_ns: (now + 600) * MS, ..request(id) })
                }
                2 => captures.on(Event::Arrived { target_id: id, stamp_ns: now * MS }),
                3 => captures.on(Event::Instant(still(now))),
                4 | 5 => captures.on(Event::Time(now * MS)),
                6 => {
                    images += usize::from(rendering);
                    captures.on(Event::Image(still(now)))
                }
                7 => captures.on(Event::ImageGone { now_ns: now * MS }),
                _ => captures.on(Event::Stored(Ok(()))),
            };
            prop_assert!(storing || !effects.contains(&Effect::Publish));
            stores += effects.iter().filter(|effect| **effect == Effect::Store).count();
            for (request_id, _) in replies(&effects) {
                *answers.entry(request_id).or_default() += 1;
            }
        }
        let waiting: Vec<u64> = match captures.state() {
            Capture::Idle => Vec::new(),
            Capture::WaitingForArrival { job } | Capture::Gating { job, .. } | Capture::Rendering { job, .. } =>
                job.askers.iter().map(|asker| asker.request_id).collect(),
            Capture::Storing { job, next, .. } =>
                job.askers.iter().chain(next.iter().flat_map(|job| &job.askers)).map(|asker| asker.request_id).collect(),
        };
        prop_assert_eq!(stores, images);
        for request_id in 1..=asked {
            let answered = answers.get(&request_id).copied().unwrap_or(0);
            prop_assert_eq!(answered, usize::from(!waiting.contains(&request_id)), "request {}", request_id);
        }
    }
}
