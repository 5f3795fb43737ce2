//! What is replayed: a recording, or a mission folder where none was made.

use std::collections::VecDeque;
use std::path::Path;

use planner::journal::{Entry, Record};
use planner::mission::PRIOR_IDS;
use recorder::recording::{Recorded, Recording, RecordingError};
use shared_types::ServiceName;
use shared_types::bus::{Envelope, RawMessage};
use shared_types::channel::{Channel, KeyframeChannel, RoundRequests};
use shared_types::config::{Config, load_mission};
use shared_types::folder::{Keyframe, MissionFolder};
use shared_types::messages::{RoundRequest, mission_key};

use crate::exit::Refusal;

/// Messages in the order in which they were sent.
pub enum Source {
    /// As recorded.
    Recording(Box<Recording>),
    /// Made of what a mission folder holds.
    Folder(Box<Config>, VecDeque<Recorded>),
}

impl core::fmt::Debug for Source {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Recording(recording) => recording.fmt(f),
            Self::Folder(_, messages) => f.debug_struct("Folder").field("messages", &messages.len()).finish(),
        }
    }
}

fn told(error: RecordingError) -> anyhow::Error {
    let text = match &error {
        RecordingError::Io { source, .. } => format!("{error}: {source}"),
        _ => error.to_string(),
    };
    match error {
        RecordingError::Io { .. } => Refusal::missing(text),
        _ => Refusal::usage(text),
    }
}

impl Source {
    /// Opens a file, or a mission folder: its recording where it has one, else its keyframes and rounds.
    ///
    /// # Errors
    /// When it is neither, or cannot be read.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        if !path.is_dir() {
            return Ok(Self::Recording(Box::new(Recording::open(path).map_err(told)?)));
        }
        let recording = path.join(recorder::writer::file_name(1));
        if recording.exists() {
            return Self::open(&recording);
        }
        let folder = MissionFolder::open(path)?;
        let config = load_mission(&folder.config_path())?;
        let messages = messages_of(&folder, &config)?;
        Ok(Self::Folder(Box::new(config), messages))
    }

    /// The configuration of then.
    #[must_use]
    pub fn config(&self) -> &Config {
        match self {
            Self::Recording(recording) => recording.config(),
            Self::Folder(config, _) => config,
        }
    }

    /// Why a recording ended before its end.
    #[must_use]
    pub fn is_cut(&self) -> Option<&str> {
        match self {
            Self::Recording(recording) => recording.is_cut(),
            Self::Folder(..) => None,
        }
    }

    /// The next message; `None` at the end.
    ///
    /// # Errors
    /// When the recording is of another version, or cannot be read.
    pub fn next_message(&mut self) -> anyhow::Result<Option<Recorded>> {
        match self {
            Self::Recording(recording) => recording.next_message().map_err(told),
            Self::Folder(_, messages) => Ok(messages.pop_front()),
        }
    }
}

/// Keyframes at their stamps, and training rounds when the planner asked for them.
fn messages_of(folder: &MissionFolder, config: &Config) -> anyhow::Result<VecDeque<Recorded>> {
    let mut messages = Vec::new();
    for id in folder.list_keyframes()? {
        let Some(keyframe) = folder.read_keyframe(id)? else { continue };
        let envelope = envelope(ServiceName::Camera, keyframe.frame.stamp_ns, id);
        let items = pixels(&keyframe);
        messages.push(recorded::<KeyframeChannel>(envelope, keyframe.frame.header(), items));
    }
    let path = folder.journal_path();
    let bytes = std::fs::read(&path).map_err(|error| {
        Refusal::missing(format!("{}: cannot be read ({error}); expected a journal", path.display()))
    })?;
    let (entries, _) = planner::journal::parse(&bytes, &path)?;
    messages.extend(rounds(&entries, config));
    messages.sort_by_key(|message| message.sent_ns);
    anyhow::ensure!(!messages.is_empty(), "{}: no keyframes; expected a mission that flew", folder.root().display());
    Ok(messages.into())
}

fn pixels(keyframe: &Keyframe) -> Vec<u8> {
    let depth = keyframe.depth_units.iter().flat_map(|units| units.to_le_bytes());
    keyframe.rgb.iter().copied().chain(depth).collect()
}

/// The training rounds of a journal, as the planner asked for them.
fn rounds(entries: &[Entry], config: &Config) -> Vec<Recorded> {
    let (mut prior, mut taken, mut messages) = (None, Vec::new(), Vec::new());
    for entry in entries {
        match &entry.record {
            Record::Prior { prior: found, .. } => prior = Some(*found),
            Record::Captured { keyframe_id, .. } if *keyframe_id < PRIOR_IDS => taken.push(*keyframe_id),
            Record::Round { round, views, max_iterations } => {
                let Some(prior) = &prior else { continue };
                let request: RoundRequest = planner::mission::round_request(
                    &config.planner,
                    config.mission.seed,
                    prior,
                    *round,
                    *max_iterations,
                );
                let keyframes: Vec<u64> = taken.iter().copied().take(*views as usize).collect();
                let mut envelope = envelope(ServiceName::Planner, entry.now_ns, u64::from(*round));
                envelope.request_id = entry.id;
                envelope.client = ServiceName::Planner.code();
                envelope.client_incarnation = mission_key(&config.mission.id, &config.mission.folder);
                messages.push(recorded::<RoundRequests>(envelope, request, keyframes));
            }
            _ => {}
        }
    }
    messages
}

fn envelope(sender: ServiceName, now_ns: u64, sequence: u64) -> Envelope {
    Envelope {
        stamp_ns: now_ns,
        sent_ns: now_ns,
        sequence,
        incarnation: 1,
        sender: sender.code(),
        ..Envelope::default()
    }
}

fn recorded<C: Channel>(envelope: Envelope, header: C::Header, items: Vec<C::Item>) -> Recorded {
    let message = RawMessage::<C>::sealed(envelope, header, items);
    Recorded { channel: C::NAME, sent_ns: message.envelope.sent_ns, bytes: message.to_bytes() }
}
