//! Recordings of missions.

use std::hint::black_box;
use std::path::Path;

use recorder::queue::{Priority, Sample};
use recorder::recording::Recording;
use recorder::writer::{Writer, file_name};
use shared_types::bus::{Envelope, RawMessage};
use shared_types::channel::{Channel, ChannelVisitor, KeyframeChannel, VehicleStateChannel, visit_all};
use shared_types::config::Config;
use shared_types::config::recorder::Compression;
use tempfile::TempDir;

thread_local! {
    static FOLDER: TempDir =
        TempDir::new_in("/dev/shm").or_else(|_full| TempDir::new()).unwrap_or_else(|error| panic!("{error}"));
}

/// Messages that a short input may hold: more are not looked at.
const MOST_MESSAGES: usize = 10_000;

/// `recording.mcap`, to its last message.
pub fn recording(data: &[u8]) {
    FOLDER.with(|folder| {
        let path = folder.path().join("recording.mcap");
        if let Err(error) = std::fs::write(&path, data) {
            panic!("{}: {error}", path.display());
        }
        let Ok(mut recording) = Recording::open(&path) else { return };
        black_box((recording.config(), recording.version()));
        for _ in 0..MOST_MESSAGES {
            match recording.next_message() {
                Ok(Some(message)) => {
                    black_box((message.json(), message.items()));
                }
                Ok(None) => break,
                Err(error) => {
                    assert!(error.to_string().contains("recording.mcap"), "{error}");
                    return;
                }
            }
        }
        black_box(recording.is_cut());
    });
}

/// Index of a channel in the table.
fn index_of(name: &str) -> usize {
    struct Names(Vec<&'static str>);
    impl ChannelVisitor for Names {
        fn visit<C: Channel>(&mut self) {
            self.0.push(C::NAME);
        }
    }
    let mut names = Names(Vec::new());
    visit_all(&mut names);
    names.0.iter().position(|known| *known == name).unwrap_or(0)
}

fn sample<C: Channel>(sequence: u64, header: C::Header, items: Vec<C::Item>) -> Sample {
    let sent_ns = 1_000_000_000 + sequence * 20_000_000;
    let envelope = Envelope { sent_ns, sequence, ..Envelope::default() };
    let bytes = RawMessage::<C>::sealed(envelope, header, items).to_bytes();
    Sample { channel: index_of(C::NAME), priority: Priority::Small, sent_ns, stamp_ns: sent_ns, sequence, bytes }
}

/// Made by the recorder, whole and cut off, compressed and not.
pub fn recording_seeds() -> Vec<Vec<u8>> {
    let mut seeds = Vec::new();
    for compression in [Compression::None, Compression::Zstd] {
        let folder = TempDir::new().unwrap_or_else(|error| panic!("{error}"));
        let mut config = Config::default();
        config.recorder.compression = compression;
        let mut writer = Writer::start(folder.path(), &config).unwrap_or_else(|error| panic!("{error}"));
        for sequence in 0..3 {
            writer.queue().offer(sample::<VehicleStateChannel>(sequence, Default::default(), Vec::new()));
        }
        writer.queue().offer(sample::<KeyframeChannel>(3, Default::default(), vec![7; 24]));
        writer.finish();
        let bytes = read(&folder.path().join(file_name(1)));
        seeds.push(bytes[..bytes.len() * 2 / 3].to_vec());
        seeds.push(bytes);
    }
    seeds
}

fn read(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}
