//! Speaking to a system that may not answer.

use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::time::Duration;

/// Does something on a system's bus, within `patience`; `None` where it took longer.
///
/// Joining a bus waits for what a killed process left half-made until the keeper has removed it; without a keeper, for ever.
/// The work is done on a thread of its own, which is left behind where that happens.
///
/// # Errors
/// Those of the work, and when there is no thread to be had.
pub fn in_time<T: Send + 'static>(
    name: &str,
    patience: Duration,
    work: impl FnOnce() -> anyhow::Result<T> + Send + 'static,
) -> anyhow::Result<Option<T>> {
    let (sender, receiver) = sync_channel(1);
    std::thread::Builder::new().name(name.to_owned()).spawn(move || {
        // Nobody listens any more when it took too long.
        sender.send(work()).ok();
    })?;
    match receiver.recv_timeout(patience) {
        Ok(result) => result.map(Some),
        Err(RecvTimeoutError::Timeout) => Ok(None),
        Err(RecvTimeoutError::Disconnected) => anyhow::bail!("the thread `{name}` ended without a result"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_that_takes_too_long_is_left_behind() {
        let work = |ms: u64| {
            in_time("work", Duration::from_secs(1), move || {
                std::thread::sleep(Duration::from_millis(ms));
                Ok(ms)
            })
        };
        assert_eq!(work(1).unwrap(), Some(1));
        assert_eq!(work(20_000).unwrap(), None);
        assert!(in_time::<()>("work", Duration::from_secs(1), || anyhow::bail!("no")).is_err());
    }
}
