//! A recording that is being written: chunks in an MCAP file, through the storage trait.

use std::collections::BTreeMap;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use mcap::WriteOptions;
use mcap::records::{MessageHeader, Metadata};
use shared_types::bus::RawMessage;
use shared_types::channel::KeyframeChannel;
use shared_types::config::recorder::Compression;
use shared_types::config::{Config, RecorderConfig};
use shared_types::messages::FrameView;
use shared_types::ns_from_s;
use shared_types::storage::{self, WriteFile};

use crate::pictures;
use crate::queue::Sample;
use crate::recording::METADATA;
use crate::topics::{self, RAW_ENCODING, SCHEMA_KEY, Topic};

/// What the writer of chunks writes to: only ever at the end.
#[derive(Debug)]
struct Sink {
    file: Box<dyn WriteFile>,
    /// Bytes so far; whoever keeps the budget looks too.
    position: Arc<AtomicU64>,
    sync_period: Duration,
    synced: Instant,
}

impl Write for Sink {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)?;
        self.position.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.synced.elapsed() >= self.sync_period {
            self.file.sync()?;
            self.synced = Instant::now();
        }
        Ok(())
    }
}

impl Seek for Sink {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        match to {
            SeekFrom::Current(0) => Ok(self.position.load(Ordering::Relaxed)),
            _ => Err(io::Error::from(io::ErrorKind::Unsupported)),
        }
    }
}

/// A channel's topics in the file.
struct Written {
    topic: Topic,
    raw: u16,
    json: Option<u16>,
    /// Colour and depth, and the least mission time between two images.
    images: Option<(u16, u16, u64)>,
    json_ns: Option<u64>,
    image_ns: Option<u64>,
}

/// A recording that is being written.
pub(crate) struct RecordingFile {
    writer: mcap::Writer<io::BufWriter<Sink>>,
    channels: Vec<Written>,
    position: Arc<AtomicU64>,
}

/// An error of the file: what the disk said, or what the format's library did.
pub(crate) fn io_error(error: mcap::McapError) -> io::Error {
    match error {
        mcap::McapError::Io(error) => error,
        other => io::Error::other(other),
    }
}

fn metadata(config: &Config) -> io::Result<Metadata> {
    let text = shared_types::config::load::to_toml(config).map_err(io::Error::other)?;
    let entries =
        [("version", env!("CARGO_PKG_VERSION").to_owned()), ("mission", config.mission.id.clone()), ("config", text)];
    let metadata = entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
    Ok(Metadata { name: METADATA.to_owned(), metadata })
}

impl RecordingFile {
    /// Makes a file that is not there yet, and writes down which topics it has.
    pub(crate) fn create(path: &Path, config: &Config) -> io::Result<Self> {
        let settings = &config.recorder;
        let position = Arc::new(AtomicU64::new(0));
        let sink = Sink {
            file: storage::of(path).create(path)?,
            position: Arc::clone(&position),
            sync_period: Duration::from_secs_f64(settings.sync_s),
            synced: Instant::now(),
        };
        let compression = match settings.compression {
            Compression::None => None,
            Compression::Zstd => Some(mcap::Compression::Zstd),
        };
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0.1 to 64 MB, as checked")]
        let chunk_bytes = (settings.chunk_mb * 1e6) as u64;
        let mut writer = WriteOptions::new()
            .library(format!("vantage {}", env!("CARGO_PKG_VERSION")))
            .compression(compression)
            .compression_level(1)
            .compression_threads(0)
            .chunk_size(Some(chunk_bytes))
            // Chunks go to the file whole: what a kill leaves can be read up to the last of them.
            .disable_seeking(true)
            .create(io::BufWriter::with_capacity(1 << 16, sink))
            .map_err(io_error)?;
        writer.write_metadata(&metadata(config)?).map_err(io_error)?;
        let channels = add_topics(&mut writer, settings).map_err(io_error)?;
        let mut file = Self { writer, channels, position };
        file.flush()?;
        Ok(file)
    }

    /// Writes a message, and what viewers get of it.
    pub(crate) fn write(&mut self, sample: &Sample) -> io::Result<()> {
        let Some(channel) = self.channels.get_mut(sample.channel) else { return Ok(()) };
        let header = |id: u16| MessageHeader {
            channel_id: id,
            // The format has 32 bits for it; the whole count is in the envelope.
            sequence: (sample.sequence & u64::from(u32::MAX)) as u32,
            log_time: sample.sent_ns,
            publish_time: sample.stamp_ns,
        };
        self.writer.write_to_known_channel(&header(channel.raw), &sample.bytes).map_err(io_error)?;
        if let (Some(id), Some(period_ns)) = (channel.json, channel.topic.json_period_ns)
            && is_due(&mut channel.json_ns, sample.sent_ns, period_ns)
            && let Some(told) = (channel.topic.json_of)(&sample.bytes)
        {
            self.writer.write_to_known_channel(&header(id), told.to_string().as_bytes()).map_err(io_error)?;
        }
        if let Some((color_id, depth_id, period_ns)) = channel.images
            && is_due(&mut channel.image_ns, sample.sent_ns, period_ns)
        {
            // Both channels of images have the same header and items.
            let Some(message) = RawMessage::<KeyframeChannel>::from_bytes(&sample.bytes) else { return Ok(()) };
            if let Some(view) = FrameView::new(&message.header, &message.items) {
                if let Some(color) = pictures::color(sample.stamp_ns, &view) {
                    self.writer.write_to_known_channel(&header(color_id), &color).map_err(io_error)?;
                }
                let depth = pictures::depth(sample.stamp_ns, &view);
                self.writer.write_to_known_channel(&header(depth_id), &depth).map_err(io_error)?;
            }
        }
        Ok(())
    }

    /// Bytes in the file so far.
    pub(crate) fn bytes(&self) -> u64 {
        self.position.load(Ordering::Relaxed)
    }

    /// Ends the chunk: what was written so far can be read, whatever happens to this process.
    pub(crate) fn flush(&mut self) -> io::Result<()> {
        self.writer.flush().map_err(io_error)
    }

    /// Writes the index. The file is whole after this.
    pub(crate) fn finish(mut self) -> io::Result<()> {
        self.writer.finish().map_err(io_error)?;
        let mut sink = self.writer.into_inner().into_inner().map_err(io::IntoInnerError::into_error)?;
        sink.file.sync()
    }
}

/// Whether so much mission time has passed since the last one. After a restart of the clock everything is due.
fn is_due(last_ns: &mut Option<u64>, now_ns: u64, period_ns: u64) -> bool {
    let due = last_ns.is_none_or(|last| now_ns < last || now_ns - last >= period_ns);
    if due {
        *last_ns = Some(now_ns);
    }
    due
}

fn add_topics<W: Write + Seek>(
    writer: &mut mcap::Writer<W>,
    settings: &RecorderConfig,
) -> mcap::McapResult<Vec<Written>> {
    let image_schema = writer.add_schema(pictures::SCHEMA, "ros2msg", pictures::DEFINITION.as_bytes())?;
    let none = BTreeMap::new();
    let mut channels = Vec::new();
    for topic in topics::all() {
        let schema = writer.add_schema(topic.name, "jsonschema", topic.json_schema.to_string().as_bytes())?;
        let key = BTreeMap::from([(SCHEMA_KEY.to_owned(), topic.schema.clone())]);
        let raw = writer.add_channel(schema, topic.name, RAW_ENCODING, &key)?;
        let json = match topic.json_period_ns {
            Some(_) => Some(writer.add_channel(schema, &format!("json/{}", topic.name), "json", &none)?),
            None => None,
        };
        let image_period_ns = match topic.name {
            "camera/keyframe" => Some(0),
            "camera/frame" if settings.preview_hz > 0.0 => Some(ns_from_s(1.0 / settings.preview_hz)),
            _ => None,
        };
        let images = match image_period_ns {
            Some(period_ns) => {
                let mut add = |kind: &str| {
                    writer.add_channel(image_schema, &format!("image/{}/{kind}", topic.name), "cdr", &none)
                };
                Some((add("color")?, add("depth")?, period_ns))
            }
            None => None,
        };
        channels.push(Written { topic, raw, json, images, json_ns: None, image_ns: None });
    }
    Ok(channels)
}
