//! The state machine of `camera/capture`: one view at a time, each keyframe once.
//!
//! ```text
//! idle -> waiting for arrival -> gating -> rendering -> storing -> idle (replied)
//!                                  ^           |
//!                                  +-- the instant is gone from the world's memory
//! ```
//! A request is the same when its client and id are, or when its keyframe id and its view are (a planner that was
//! restarted asks with a new id): it joins the work, or is answered from the disk. A request for another keyframe takes
//! the place of one that is not yet being stored: the vehicle has been sent elsewhere.

use std::collections::VecDeque;

use shared_types::bus::ReplyAddress;
use shared_types::folder::Frame;
use shared_types::messages::{CaptureReply, CaptureRequest, CaptureStatus, KeyframeReason};
use shared_types::payload::pack_text;

use crate::logic::gate::{Gate, Limits, Shot};

/// Answers remembered for requests that are repeated because the reply was lost.
const REMEMBERED: usize = 64;

/// A view to be taken, and who wants to know.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// What was asked for.
    pub request: CaptureRequest,
    /// Everyone who asked.
    pub askers: Vec<ReplyAddress>,
}

/// What the camera does about captures.
#[derive(Debug, Clone, PartialEq)]
pub enum Capture {
    /// Nothing is asked for.
    Idle,
    /// The vehicle is on its way to the view.
    WaitingForArrival {
        /// The view.
        job: Job,
    },
    /// The vehicle is there; the stillest instant is looked for.
    Gating {
        /// The view.
        job: Job,
        /// What has been seen since the arrival.
        gate: Gate,
    },
    /// The instant is chosen, its image is awaited.
    Rendering {
        /// The view.
        job: Job,
        /// The instant.
        shot: Shot,
    },
    /// The image is being brought to the disk.
    Storing {
        /// The view.
        job: Job,
        /// Its instant.
        shot: Shot,
        /// What is asked for next.
        next: Option<Job>,
    },
}

/// What happens to a capture.
#[derive(Debug)]
pub enum Event<'a> {
    /// A request has come; `stored` is what lies on the disk for its keyframe.
    Asked {
        /// The request.
        request: CaptureRequest,
        /// From whom.
        from: ReplyAddress,
        /// The frame on the disk, if any.
        stored: Option<&'a Frame>,
    },
    /// A request has come, and whether its keyframe exists cannot be told.
    Unanswerable {
        /// The request.
        request: CaptureRequest,
        /// From whom.
        from: ReplyAddress,
        /// Why.
        reason: String,
    },
    /// The vehicle is at the end of a target at an instant.
    Arrived {
        /// Id of the target.
        target_id: u64,
        /// Mission time.
        stamp_ns: u64,
    },
    /// An instant at which the image could be taken.
    Instant(Shot),
    /// Mission time has come to this.
    Time(u64),
    /// The image has come; a source with frames of its own gives the instant it has.
    Image(Shot),
    /// The source no longer has that instant.
    ImageGone {
        /// Mission time now.
        now_ns: u64,
    },
    /// There will be no image.
    ImageRefused(String),
    /// The keyframe is on the disk, or could not be brought there.
    Stored(Result<(), String>),
}

/// What is to be done.
#[derive(Debug, Clone, PartialEq)]
pub enum Effect {
    /// Ask the source for the image of an instant.
    Render(Shot),
    /// Forget the image asked for.
    CancelRender,
    /// Bring the image at hand to the disk.
    Store,
    /// Publish the keyframe just stored.
    Publish,
    /// Publish the keyframe that is on the disk: this life of the camera has not yet.
    Republish(CaptureRequest),
    /// Answer a request.
    Reply(ReplyAddress, CaptureReply),
}

/// The machine, with its memory of answers.
#[derive(Debug)]
pub struct Captures {
    limits: Limits,
    state: Capture,
    answered: VecDeque<(ReplyAddress, CaptureRequest, CaptureReply)>,
}

impl Captures {
    /// An idle camera.
    #[must_use]
    pub fn new(limits: Limits) -> Self {
        Self { limits, state: Capture::Idle, answered: VecDeque::new() }
    }

    /// What the camera does now.
    #[must_use]
    pub fn state(&self) -> &Capture {
        &self.state
    }

    /// Forgets what was in flight; it will be asked for again.
    pub fn forget(&mut self) {
        self.state = Capture::Idle;
    }

    /// Takes an event; returns what is to be done, in order.
    pub fn on(&mut self, event: Event<'_>) -> Vec<Effect> {
        let mut effects = Vec::new();
        let state = core::mem::replace(&mut self.state, Capture::Idle);
        self.state = match event {
            Event::Asked { request, from, stored } => self.asked(state, request, from, stored, &mut effects),
            Event::Unanswerable { request, from, reason } => {
                let job = Job { request, askers: vec![from] };
                let reply = failed(&job, CaptureStatus::Failed, &reason);
                // Not remembered: what is in the way may be mended, and the same request then be taken.
                effects.push(Effect::Reply(from, reply));
                state
            }
            Event::Arrived { target_id, stamp_ns } => self.arrived(state, target_id, stamp_ns),
            Event::Instant(shot) => offered(state, shot),
            Event::Time(now_ns) => self.timed(state, now_ns, &mut effects),
            Event::Image(shot) => match state {
                Capture::Rendering { job, .. } => {
                    effects.push(Effect::Store);
                    Capture::Storing { job, shot, next: None }
                }
                other => other,
            },
            Event::ImageGone { now_ns } => match state {
                Capture::Rendering { job, .. } => Capture::Gating { job, gate: Gate::new(self.limits, now_ns) },
                other => other,
            },
            Event::ImageRefused(reason) => match state {
                Capture::Rendering { job, .. } => {
                    self.finish(&job, failed(&job, CaptureStatus::Failed, &reason), &mut effects);
                    Capture::Idle
                }
                other => other,
            },
            Event::Stored(result) => self.stored(state, result, &mut effects),
        };
        effects
    }

    fn asked(
        &mut self,
        state: Capture,
        request: CaptureRequest,
        from: ReplyAddress,
        stored: Option<&Frame>,
        effects: &mut Vec<Effect>,
    ) -> Capture {
        let job = Job { request, askers: vec![from] };
        if let Some((_, known, reply)) = self.answered.iter().find(|(address, ..)| *address == from) {
            let reply =
                if same_view(known, &request) { *reply } else { contradicts(&job, "the request of the same id") };
            effects.push(Effect::Reply(from, reply));
            return state;
        }
        if !takes_keyframes(&request) {
            let why = format!("reason code {} is not that of a keyframe", request.reason);
            self.finish(&job, failed(&job, CaptureStatus::Refused, &why), effects);
            return state;
        }
        if let Some(frame) = stored {
            if is_view_of(frame, &request) {
                effects.push(Effect::Republish(request));
                self.finish(&job, done(&job, frame.stamp_ns, frame.gate.missed), effects);
            } else {
                self.finish(&job, contradicts(&job, "the keyframe on disk"), effects);
            }
            return state;
        }
        match state {
            Capture::Idle => Capture::WaitingForArrival { job },
            Capture::WaitingForArrival { job: held } => match self.joined(held, job, effects) {
                Ok(held) => Capture::WaitingForArrival { job: held },
                Err(job) => Capture::WaitingForArrival { job },
            },
            Capture::Gating { job: held, gate } => {
                let target_id = held.request.target_id;
                match self.joined(held, job, effects) {
                    // Another target: the vehicle has left and will arrive again.
                    Ok(held) if held.request.target_id != target_id => Capture::WaitingForArrival { job: held },
                    Ok(held) => Capture::Gating { job: held, gate },
                    Err(job) => Capture::WaitingForArrival { job },
                }
            }
            Capture::Rendering { job: held, shot } => match self.joined(held, job, effects) {
                Ok(held) => Capture::Rendering { job: held, shot },
                Err(job) => {
                    effects.push(Effect::CancelRender);
                    Capture::WaitingForArrival { job }
                }
            },
            Capture::Storing { job: held, shot, next } => {
                if held.request.keyframe_id != job.request.keyframe_id {
                    let next = match next {
                        Some(waiting) => self.joined(waiting, job, effects).unwrap_or_else(|job| job),
                        None => job,
                    };
                    return Capture::Storing { job: held, shot, next: Some(next) };
                }
                match self.joined(held, job, effects) {
                    Ok(held) | Err(held) => Capture::Storing { job: held, shot, next },
                }
            }
        }
    }

    /// `Ok`: the request concerns the keyframe in work, and has joined it or been refused. `Err`: it is for another
    /// keyframe, and the one in work has been given up for it.
    fn joined(&mut self, held: Job, job: Job, effects: &mut Vec<Effect>) -> Result<Job, Job> {
        if held.request.keyframe_id != job.request.keyframe_id {
            let why = format!("given up for keyframe {}", job.request.keyframe_id);
            self.finish(&held, failed(&held, CaptureStatus::Failed, &why), effects);
            return Err(job);
        }
        if !same_view(&held.request, &job.request) {
            self.finish(&job, contradicts(&job, "the keyframe in work"), effects);
            return Ok(held);
        }
        // The newest request knows the vehicle's present target and the deadline that holds.
        let mut askers = held.askers;
        for asker in job.askers {
            if !askers.contains(&asker) {
                askers.push(asker);
            }
        }
        Ok(Job { request: job.request, askers })
    }

    fn arrived(&self, state: Capture, target_id: u64, stamp_ns: u64) -> Capture {
        match state {
            Capture::WaitingForArrival { job } if job.request.target_id == 0 || job.request.target_id == target_id => {
                Capture::Gating { job, gate: Gate::new(self.limits, stamp_ns) }
            }
            other => other,
        }
    }

    fn timed(&mut self, state: Capture, now_ns: u64, effects: &mut Vec<Effect>) -> Capture {
        let late = |job: &Job| job.request.deadline_ns != 0 && now_ns >= job.request.deadline_ns;
        match state {
            Capture::WaitingForArrival { job } if late(&job) => {
                self.finish(&job, failed(&job, CaptureStatus::TimedOut, "the vehicle did not arrive in time"), effects);
                Capture::Idle
            }
            Capture::Gating { job, .. } if late(&job) => {
                self.finish(&job, failed(&job, CaptureStatus::TimedOut, "no pose was known in time"), effects);
                Capture::Idle
            }
            Capture::Rendering { job, .. } if late(&job) => {
                effects.push(Effect::CancelRender);
                self.finish(&job, failed(&job, CaptureStatus::TimedOut, "the image did not come in time"), effects);
                Capture::Idle
            }
            Capture::Gating { job, gate } => match gate.decide(now_ns) {
                Some(shot) => {
                    effects.push(Effect::Render(shot));
                    Capture::Rendering { job, shot }
                }
                None => Capture::Gating { job, gate },
            },
            other => other,
        }
    }

    fn stored(&mut self, state: Capture, result: Result<(), String>, effects: &mut Vec<Effect>) -> Capture {
        let Capture::Storing { job, shot, next } = state else { return state };
        let reply = match result {
            Ok(()) => {
                effects.push(Effect::Publish);
                done(&job, shot.stamp_ns, shot.gate_missed)
            }
            Err(reason) => failed(&job, CaptureStatus::Failed, &reason),
        };
        self.finish(&job, reply, effects);
        next.map_or(Capture::Idle, |job| Capture::WaitingForArrival { job })
    }

    fn finish(&mut self, job: &Job, reply: CaptureReply, effects: &mut Vec<Effect>) {
        for asker in &job.askers {
            effects.push(Effect::Reply(*asker, reply));
            if self.answered.len() == REMEMBERED {
                self.answered.pop_front();
            }
            self.answered.push_back((*asker, job.request, reply));
        }
    }
}

fn offered(state: Capture, shot: Shot) -> Capture {
    match state {
        Capture::Gating { job, mut gate } => {
            gate.offer(shot);
            Capture::Gating { job, gate }
        }
        other => other,
    }
}

fn takes_keyframes(request: &CaptureRequest) -> bool {
    !matches!(KeyframeReason::from_code(request.reason), None | Some(KeyframeReason::Stream))
}

/// Whether two requests of one keyframe mean the same view. The target and the deadline may differ: a planner that was
/// restarted flies there by a new target.
fn same_view(a: &CaptureRequest, b: &CaptureRequest) -> bool {
    a.keyframe_id == b.keyframe_id
        && (a.reason, a.candidate) == (b.reason, b.candidate)
        && same_point(&a.look_at_m, &b.look_at_m)
}

fn is_view_of(frame: &Frame, request: &CaptureRequest) -> bool {
    frame.id == request.keyframe_id
        && frame.reason.code() == request.reason
        && frame.candidate.unwrap_or(u32::MAX) == request.candidate
        && same_point(&frame.look_at_m, &request.look_at_m)
}

fn same_point(a: &[f64; 3], b: &[f64; 3]) -> bool {
    a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 1e-9)
}

fn done(job: &Job, image_stamp_ns: u64, gate_missed: bool) -> CaptureReply {
    CaptureReply {
        keyframe_id: job.request.keyframe_id,
        image_stamp_ns,
        status: CaptureStatus::Stored.code(),
        gate_missed: u32::from(gate_missed),
        ..CaptureReply::default()
    }
}

fn failed(job: &Job, status: CaptureStatus, reason: &str) -> CaptureReply {
    CaptureReply {
        keyframe_id: job.request.keyframe_id,
        status: status.code(),
        reason: pack_text(reason),
        ..CaptureReply::default()
    }
}

fn contradicts(job: &Job, what: &str) -> CaptureReply {
    let why = format!("keyframe {}: another view than {what}; use a new id", job.request.keyframe_id);
    failed(job, CaptureStatus::Refused, &why)
}

#[cfg(test)]
mod tests;
