//! Sends recorded messages again, and stores keyframes where the services read them.

use std::collections::{BTreeMap, BTreeSet};

use recorder::recording::Recorded;
use shared_types::ServiceName;
use shared_types::bus::{Bus, BusError, Publisher, RawMessage};
use shared_types::channel::{CaptureRequests, Channel, ChannelVisitor, ControlChannel, KeyframeChannel, visit_all};
use shared_types::config::Config;
use shared_types::folder::{Frame, Gate, Keyframe, MissionFolder};
use shared_types::messages::{CaptureRequest, ControlCommand, ControlRequest, FrameView, KeyframeReason};

use super::source::Source;
use crate::clock::monotonic_ns;

/// Channels that belong to the processes of then and not to the mission.
const NOT_AGAIN: [&str; 6] = ["clock", "clock/grant", "health", "health/last", "control/request", "control/reply"];
/// Free chunks are waited for in so many steps of a millisecond: a reader of a model is slow.
const CHUNK_PATIENCE_MS: u32 = 500;

/// A channel on which messages are sent again.
trait Again {
    /// The sender of a message, by its code.
    fn sender(&self, bytes: &[u8]) -> Option<u32>;
    fn send(&mut self, bus: &Bus, bytes: &[u8]) -> Result<(), BusError>;
    /// Whether a late joiner is told the last message.
    fn is_state(&self) -> bool;
}

struct Line<C: Channel>(Option<Publisher<C>>);

impl<C: Channel> Again for Line<C> {
    fn sender(&self, bytes: &[u8]) -> Option<u32> {
        Some(RawMessage::<C>::envelope_of(bytes)?.sender)
    }

    fn send(&mut self, bus: &Bus, bytes: &[u8]) -> Result<(), BusError> {
        let Some(message) = RawMessage::<C>::from_bytes(bytes) else {
            tracing::warn!(channel = C::NAME, "a damaged message of the recording is left out");
            return Ok(());
        };
        let publisher = match &mut self.0 {
            Some(publisher) => publisher,
            empty => empty.insert(bus.publisher::<C>()?),
        };
        for _ in 0..CHUNK_PATIENCE_MS {
            match publisher.send_again(&message) {
                Err(BusError::NoChunk { .. }) => std::thread::sleep(core::time::Duration::from_millis(1)),
                other => return other,
            }
        }
        tracing::warn!(channel = C::NAME, "no free chunk: a message of the recording is left out");
        Ok(())
    }

    fn is_state(&self) -> bool {
        C::SETTINGS.history > 0
    }
}

/// Sends what others sent.
pub struct Player {
    bus: Bus,
    lines: BTreeMap<&'static str, Box<dyn Again>>,
    /// Who speaks for himself.
    alive: BTreeSet<u32>,
    folder: MissionFolder,
    /// By keyframe: what the view was to show.
    requests: BTreeMap<u64, CaptureRequest>,
    next: Option<Recorded>,
    over: bool,
    messages: u64,
}

impl Player {
    /// A player for everything but what `services` send themselves.
    ///
    /// # Errors
    /// When the mission folder of the configuration cannot be opened.
    pub fn open(bus: &Bus, config: &Config, services: &[ServiceName]) -> anyhow::Result<Self> {
        struct Lines(BTreeMap<&'static str, Box<dyn Again>>);
        impl ChannelVisitor for Lines {
            fn visit<C: Channel>(&mut self) {
                if !NOT_AGAIN.contains(&C::NAME) {
                    self.0.insert(C::NAME, Box::new(Line::<C>(None)));
                }
            }
        }
        let mut lines = Lines(BTreeMap::new());
        visit_all(&mut lines);
        Ok(Self {
            bus: bus.clone(),
            lines: lines.0,
            alive: services.iter().map(|service| service.code()).collect(),
            folder: MissionFolder::open(&config.mission.folder)?,
            requests: BTreeMap::new(),
            next: None,
            over: false,
            messages: 0,
        })
    }

    /// Messages sent so far.
    #[must_use]
    pub fn messages(&self) -> u64 {
        self.messages
    }

    /// Whether everything was sent.
    #[must_use]
    pub fn is_over(&self) -> bool {
        self.over
    }

    /// Passes over the first `from_ns` of the recording: of it, keyframes are stored and the last state of each channel that
    /// has one is sent. Gives the mission time at which the replay begins.
    ///
    /// # Errors
    /// When the recording or the folder cannot be used, or there is nothing to replay.
    pub fn skip_to(&mut self, source: &mut Source, from_ns: u64) -> anyhow::Result<u64> {
        let mut first_ns = None;
        let mut states: BTreeMap<&'static str, Recorded> = BTreeMap::new();
        loop {
            let Some(message) = source.next_message()? else {
                let why = "no message is left to replay; expected a longer recording, or a smaller --from";
                return Err(crate::exit::Refusal::usage(why));
            };
            if !self.is_sent_again(&message) {
                continue;
            }
            let begin_ns = *first_ns.get_or_insert(message.sent_ns) + from_ns;
            if message.sent_ns >= begin_ns {
                self.next = Some(message);
                for state in states.into_values() {
                    self.send(&state)?;
                }
                return Ok(begin_ns);
            }
            self.note(&message)?;
            if self.lines.get(message.channel).is_some_and(|line| line.is_state()) {
                states.insert(message.channel, message);
            }
        }
    }

    fn is_sent_again(&self, message: &Recorded) -> bool {
        let sender = self.lines.get(message.channel).and_then(|line| line.sender(&message.bytes));
        sender.is_some_and(|sender| !self.alive.contains(&sender))
    }

    /// Sends everything that was sent before a time.
    ///
    /// # Errors
    /// When the recording, a channel or the folder cannot be used.
    pub fn send_until(&mut self, source: &mut Source, until_ns: u64) -> anyhow::Result<()> {
        loop {
            let message = match self.next.take() {
                Some(message) => message,
                None => match source.next_message()? {
                    Some(message) => message,
                    None => {
                        self.over = true;
                        return Ok(());
                    }
                },
            };
            if !self.is_sent_again(&message) {
                continue;
            }
            if message.sent_ns >= until_ns {
                self.next = Some(message);
                return Ok(());
            }
            self.note(&message)?;
            self.send(&message)?;
        }
    }

    fn send(&mut self, message: &Recorded) -> anyhow::Result<()> {
        if let Some(line) = self.lines.get_mut(message.channel) {
            line.send(&self.bus, &message.bytes)?;
            self.messages += 1;
        }
        Ok(())
    }

    /// A keyframe is in the folder before it is announced, as the camera has it.
    fn note(&mut self, message: &Recorded) -> anyhow::Result<()> {
        if message.channel == CaptureRequests::NAME {
            if let Some(request) = RawMessage::<CaptureRequests>::from_bytes(&message.bytes) {
                self.requests.insert(request.header.keyframe_id, request.header);
            }
            return Ok(());
        }
        if message.channel != KeyframeChannel::NAME {
            return Ok(());
        }
        let Some(announced) = RawMessage::<KeyframeChannel>::from_bytes(&message.bytes) else { return Ok(()) };
        let Some(view) = FrameView::new(&announced.header, &announced.items) else { return Ok(()) };
        let keyframe = keyframe(announced.envelope.stamp_ns, &view, self.requests.get(&announced.header.id));
        match self.folder.write_keyframe(&keyframe) {
            // Announced twice: by a camera that was started again.
            Ok(_) | Err(shared_types::folder::FolderError::Exists { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Tells services that somebody else started that there is no more.
    ///
    /// # Errors
    /// When the channel cannot be opened.
    pub fn dismiss(&self, services: &[ServiceName]) -> anyhow::Result<()> {
        let mut client = self.bus.client::<ControlChannel>()?;
        for (id, service) in (monotonic_ns()..).zip(services) {
            let command = ControlCommand::Stop.code();
            client.send(
                0,
                id,
                &ControlRequest { command, service: service.code(), ..ControlRequest::default() },
                &[],
            )?;
        }
        // They look ten times a second.
        std::thread::sleep(core::time::Duration::from_millis(300));
        Ok(())
    }
}

/// The keyframe of a message and of the request for it.
fn keyframe(stamp_ns: u64, view: &FrameView<'_>, request: Option<&CaptureRequest>) -> Keyframe {
    let header = view.header;
    let frame = Frame {
        id: header.id,
        stamp_ns,
        reason: KeyframeReason::from_code(header.reason).unwrap_or(KeyframeReason::Stream),
        candidate: (header.candidate != u32::MAX).then_some(header.candidate),
        target_id: request.map_or(0, |request| request.target_id),
        look_at_m: request.map_or([0.0; 3], |request| request.look_at_m),
        world_from_camera_position_m: header.world_from_camera_position_m,
        world_from_camera_xyzw: header.world_from_camera_xyzw,
        intrinsics: header.intrinsics(),
        depth_unit_m: header.depth_unit_m,
        gate: Gate {
            missed: header.gate_missed == 1,
            speed_mps: header.speed_mps,
            rate_radps: header.rate_radps,
            time_uncertainty_s: header.time_uncertainty_s,
            ..Gate::default()
        },
        exposure: Default::default(),
    };
    Keyframe { frame, rgb: view.rgb.to_vec(), depth_units: view.depth_units_vec() }
}
