//! Reading a recording: what it is of, and its messages in their order.
//!
//! A file that was cut off, by a kill or a power cut, is read up to its last whole chunk: [`Recording::is_cut`] tells.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, parse_record};
use shared_types::config::{Config, Layer, load};

use crate::topics::{self, RAW_ENCODING, SCHEMA_KEY};

/// Name of the metadata record that says what a recording is of.
pub(crate) const METADATA: &str = "vantage";
/// Longest record, bytes: a chunk of 64 MB and a model of four million Gaussians beyond its end.
const LONGEST_RECORD: usize = 400 << 20;
/// Longest record of a short file: what a few bytes claim to hold takes no memory out of proportion.
const LONGEST_RECORD_OF_LITTLE: usize = 64 << 20;
/// What records are compressed to is at least the hundredth part.
const MOST_COMPRESSED: u64 = 100;
/// Most bytes that are read at once.
const READ_BYTES: usize = 1 << 20;

/// Why a recording cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The file cannot be read.
    #[error("{}: cannot be read; expected a recording (recording.mcap of a mission folder)", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The operating system's word.
        #[source]
        source: std::io::Error,
    },
    /// Not an MCAP file at all.
    #[error("{}: not an MCAP file ({cause}); expected a recording that `vantage fly --set recorder.enabled=true` made", path.display())]
    NotMcap {
        /// The file.
        path: PathBuf,
        /// What was found.
        cause: String,
    },
    /// An MCAP file of somebody else.
    #[error("{}: an MCAP file, but no recording of Vantage: it says nothing of the mission's configuration; expected one that the recorder made", path.display())]
    Foreign {
        /// The file.
        path: PathBuf,
    },
    /// Its configuration is not one of this version.
    #[error("{}: made by Vantage {version}, whose configuration this version ({}) does not take: {cause}; replay it with that version", path.display(), env!("CARGO_PKG_VERSION"))]
    Configuration {
        /// The file.
        path: PathBuf,
        /// Who made it.
        version: String,
        /// What is wrong.
        cause: String,
    },
    /// A channel that is laid out otherwise now.
    #[error("{}: channel {channel} has schema {found}, expected {expected}: made by Vantage {version}, this is {}; replay it with that version", path.display(), env!("CARGO_PKG_VERSION"))]
    Schema {
        /// The file.
        path: PathBuf,
        /// Which channel.
        channel: String,
        /// Its hash in the file.
        found: String,
        /// Its hash here.
        expected: String,
        /// Who made it.
        version: String,
    },
}

/// A message of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Recorded {
    /// Name of its channel.
    pub channel: &'static str,
    /// Mission time when it was sent, nanoseconds.
    pub sent_ns: u64,
    /// Envelope, header and items; [`shared_types::bus::RawMessage`] reads them.
    pub bytes: Vec<u8>,
}

impl Recorded {
    fn topic(&self) -> Option<topics::Topic> {
        topics::all().into_iter().find(|topic| topic.name == self.channel)
    }

    /// What it says, as viewers are told; `None` where it is damaged.
    #[must_use]
    pub fn json(&self) -> Option<serde_json::Value> {
        (self.topic()?.json_of)(&self.bytes)
    }

    /// The bytes of its items.
    #[must_use]
    pub fn items(&self) -> &[u8] {
        self.topic().and_then(|topic| self.bytes.get(topic.head_bytes..)).unwrap_or_default()
    }
}

/// A recording that is being read.
pub struct Recording {
    path: PathBuf,
    file: File,
    reader: LinearReader,
    config: Config,
    version: String,
    /// Names of the channels whose bytes are replayed, by their ids in the file.
    channels: BTreeMap<u16, &'static str>,
    cut: Option<String>,
}

impl core::fmt::Debug for Recording {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Recording").field("path", &self.path).field("version", &self.version).finish_non_exhaustive()
    }
}

/// What comes next in a file.
enum Next {
    Metadata(BTreeMap<String, String>),
    Channel(mcap::records::Channel),
    Message { channel: u16, sent_ns: u64, bytes: Vec<u8> },
    Other,
    End,
}

impl Recording {
    /// Opens a recording, and reads what it is of.
    ///
    /// # Errors
    /// When the file cannot be read, is no MCAP, is somebody else's, or of another version.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let io = |source| RecordingError::Io { path: path.to_owned(), source };
        let file = File::open(path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len().saturating_mul(MOST_COMPRESSED);
        let longest = usize::try_from(length).unwrap_or(usize::MAX).clamp(LONGEST_RECORD_OF_LITTLE, LONGEST_RECORD);
        let options = LinearReaderOptions::default().with_record_length_limit(longest);
        let mut recording = Self {
            path: path.to_owned(),
            file,
            reader: LinearReader::new_with_options(options),
            config: Config::default(),
            version: String::new(),
            channels: BTreeMap::new(),
            cut: None,
        };
        recording.read_metadata()?;
        Ok(recording)
    }

    /// The configuration of the mission that was recorded.
    #[must_use]
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// The version that recorded it.
    #[must_use]
    pub fn version(&self) -> &str {
        &self.version
    }

    /// Why the file ended before its end; `None` while it did not. What was before is whole.
    #[must_use]
    pub fn is_cut(&self) -> Option<&str> {
        self.cut.as_deref()
    }

    fn read_metadata(&mut self) -> Result<(), RecordingError> {
        let path = self.path.clone();
        let entries = loop {
            match self.next_record() {
                Ok(Next::Metadata(entries)) => break entries,
                // Everything else comes behind it.
                Ok(Next::Other | Next::Channel(_)) => {}
                Ok(Next::Message { .. } | Next::End) => return Err(RecordingError::Foreign { path }),
                Err(McapError::Io(source)) => return Err(RecordingError::Io { path, source }),
                Err(error) => return Err(RecordingError::NotMcap { path, cause: error.to_string() }),
            }
        };
        let (Some(text), Some(version)) = (entries.get("config"), entries.get("version")) else {
            return Err(RecordingError::Foreign { path });
        };
        self.version.clone_from(version);
        let layer = Layer { name: path.display().to_string(), text: text.clone(), has_lines: false };
        self.config = load(&[layer]).map_err(|error| RecordingError::Configuration {
            path,
            version: version.clone(),
            cause: error.to_string(),
        })?;
        Ok(())
    }

    /// The next message of a channel; `None` at the end.
    ///
    /// # Errors
    /// When a channel is laid out otherwise now, or the file cannot be read. Damage is no error but an end.
    pub fn next_message(&mut self) -> Result<Option<Recorded>, RecordingError> {
        while self.cut.is_none() {
            match self.next_record() {
                Ok(Next::Message { channel, sent_ns, bytes }) => {
                    if let Some(&channel) = self.channels.get(&channel) {
                        return Ok(Some(Recorded { channel, sent_ns, bytes }));
                    }
                }
                Ok(Next::Channel(channel)) => self.meet(channel)?,
                Ok(Next::Metadata(_) | Next::Other) => {}
                Ok(Next::End) => return Ok(None),
                Err(McapError::Io(source)) if source.kind() != std::io::ErrorKind::UnexpectedEof => {
                    return Err(RecordingError::Io { path: self.path.clone(), source });
                }
                Err(error) => self.cut = Some(error.to_string()),
            }
        }
        Ok(None)
    }

    /// A channel's record: those of our own bytes must be laid out as they are here.
    fn meet(&mut self, channel: mcap::records::Channel) -> Result<(), RecordingError> {
        if channel.message_encoding != RAW_ENCODING {
            return Ok(());
        }
        let found = channel.metadata.get(SCHEMA_KEY).cloned().unwrap_or_default();
        let known = topics::all().into_iter().find(|topic| topic.name == channel.topic);
        match known {
            Some(topic) if topic.schema == found => {
                self.channels.insert(channel.id, topic.name);
                Ok(())
            }
            known => Err(RecordingError::Schema {
                path: self.path.clone(),
                channel: channel.topic,
                found,
                expected: known.map_or_else(|| "no such channel".to_owned(), |topic| topic.schema),
                version: self.version.clone(),
            }),
        }
    }

    fn next_record(&mut self) -> Result<Next, McapError> {
        loop {
            let Some(event) = self.reader.next_event() else { return Ok(Next::End) };
            match event? {
                LinearReadEvent::ReadRequest(wanted) => {
                    // A piece at a time: how long a record is said to be takes no memory before it is there.
                    let wanted = wanted.clamp(1, READ_BYTES);
                    let read = self.file.read(self.reader.insert(wanted))?;
                    self.reader.notify_read(read);
                }
                LinearReadEvent::Record { data, opcode } => {
                    if !matches!(opcode, op::METADATA | op::CHANNEL | op::MESSAGE) {
                        return Ok(Next::Other);
                    }
                    if !lengths_fit(opcode, data) {
                        return Err(McapError::UnexpectedEof);
                    }
                    return Ok(match parse_record(opcode, data)? {
                        Record::Metadata(metadata) if metadata.name == METADATA => Next::Metadata(metadata.metadata),
                        Record::Channel(channel) => Next::Channel(channel),
                        Record::Message { header, data } => Next::Message {
                            channel: header.channel_id,
                            sent_ns: header.log_time,
                            bytes: data.into_owned(),
                        },
                        _ => Next::Other,
                    });
                }
            }
        }
    }
}

/// Whether the strings of a record end within it: its parser takes the memory that their lengths claim.
fn lengths_fit(opcode: u8, data: &[u8]) -> bool {
    let (ids, strings) = match opcode {
        op::CHANNEL => (4, 2),
        op::METADATA => (0, 1),
        _ => return true,
    };
    let map = (0..strings).try_fold(data.get(ids..).unwrap_or_default(), |rest, _| Some(counted(rest)?.1));
    let Some((mut map, _)) = map.and_then(counted) else { return false };
    while !map.is_empty() {
        match counted(map) {
            Some((_, rest)) => map = rest,
            None => return false,
        }
    }
    true
}

/// Bytes behind their number, and the rest.
fn counted(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = bytes.split_first_chunk()?;
    rest.split_at_checked(u32::from_le_bytes(*length).try_into().ok()?)
}
