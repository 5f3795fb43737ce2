//! The last message that this process received on each channel.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use crate::service::ServiceName;

#[derive(Debug, Clone, Copy)]
struct Heard {
    sender: u32,
    sequence: u64,
    sent_ns: u64,
}

static HEARD: Mutex<BTreeMap<&'static str, Heard>> = Mutex::new(BTreeMap::new());

/// Notes a message: the code of the service that sent it, its number, and when it was sent.
pub(crate) fn note(channel: &'static str, sender: u32, sequence: u64, sent_ns: u64) {
    HEARD.lock().unwrap_or_else(PoisonError::into_inner).insert(channel, Heard { sender, sequence, sent_ns });
}

/// A line for each channel. None where another thread notes one just now: whoever asks may be that thread, in a panic.
pub(crate) fn told() -> String {
    let Ok(heard) = HEARD.try_lock() else { return String::new() };
    heard
        .iter()
        .map(|(channel, Heard { sender, sequence, sent_ns })| {
            let sender = ServiceName::from_code(*sender).map_or("somebody", ServiceName::name);
            format!("{channel} from {sender}, number {sequence}, sent at {:.3} s\n", *sent_ns as f64 / 1e9)
        })
        .collect()
}
