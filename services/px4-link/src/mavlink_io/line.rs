//! TCP and serial lines: one end only, opened again whenever they break.
//!
//! A thread opens the line, reads it, and opens it again after an error, its end, or a silence in which even heartbeats
//! stay away (a cable that was pulled says nothing). Writing never waits: the setpoint thread shares it.

use std::io::{ErrorKind, Read, Write as _};
use std::net::{TcpListener, TcpStream};
use std::sync::mpsc::{SyncSender, TrySendError};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use rustix::net::{SendFlags, send};
use serialport::SerialPort;

use super::codec::{Received, take_frames};

/// Between two tries to open.
const AGAIN: Duration = Duration::from_secs(1);
/// One read waits this long.
const READ: Duration = Duration::from_millis(100);
/// A serial write waits this long for room.
const WRITE: Duration = Duration::from_millis(2);
/// An autopilot sends a heartbeat each second: after this the line is dead.
const SILENCE: Duration = Duration::from_secs(5);

enum Writer {
    Tcp(TcpStream),
    Serial(Box<dyn SerialPort>),
}

/// The line's writing end, while there is one.
#[derive(Default)]
pub(super) struct Line(Mutex<Option<Writer>>);

impl Line {
    fn writer(&self) -> MutexGuard<'_, Option<Writer>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sends bytes, or drops them where there is no room. A frame that is cut is skipped by its reader.
    pub(super) fn send(&self, bytes: &[u8]) -> bool {
        match self.writer().as_mut() {
            None => false,
            Some(Writer::Tcp(stream)) => {
                send(stream, bytes, SendFlags::DONTWAIT | SendFlags::NOSIGNAL) == Ok(bytes.len())
            }
            Some(Writer::Serial(port)) => port.write_all(bytes).is_ok(),
        }
    }
}

fn open(url: &str) -> std::io::Result<(Box<dyn Read>, Writer)> {
    let stream = if let Some(address) = url.strip_prefix("tcpout:") {
        TcpStream::connect(address)?
    } else if let Some(address) = url.strip_prefix("tcpin:") {
        TcpListener::bind(address)?.accept()?.0
    } else {
        let place = url.strip_prefix("serial:").and_then(|place| place.rsplit_once(':'));
        let (device, baud) = place.ok_or_else(|| std::io::Error::other("neither tcpout, tcpin nor serial"))?;
        let baud = baud.parse().map_err(std::io::Error::other)?;
        let reader = serialport::new(device, baud).timeout(READ).open()?;
        let mut writer = reader.try_clone()?;
        writer.set_timeout(WRITE)?;
        return Ok((Box::new(reader), Writer::Serial(writer)));
    };
    stream.set_read_timeout(Some(READ))?;
    stream.set_nodelay(true)?;
    let writer = stream.try_clone()?;
    Ok((Box::new(stream), Writer::Tcp(writer)))
}

/// Reads a line until nobody wants its messages any more; drops messages while the queue is full.
pub(super) fn read(url: &str, line: &Line, queue: &SyncSender<Received>) {
    let mut told = false;
    loop {
        match open(url) {
            Ok((mut reader, writer)) => {
                told = false;
                *line.writer() = Some(writer);
                let broken = pump(reader.as_mut(), queue);
                *line.writer() = None;
                let Some(error) = broken else { return };
                tracing::warn!(url, %error, "the line to the autopilot broke; opening it again");
            }
            Err(error) => {
                if !told {
                    told = true;
                    tracing::warn!(url, %error, "cannot reach the autopilot; trying again every second");
                }
            }
        }
        std::thread::sleep(AGAIN);
    }
}

/// Reads until the line breaks: why. `None` when nobody wants the messages any more.
fn pump(reader: &mut dyn Read, queue: &SyncSender<Received>) -> Option<std::io::Error> {
    let mut buffer = [0; 4096];
    let mut bytes = Vec::new();
    let mut heard = Instant::now();
    loop {
        match reader.read(&mut buffer) {
            Ok(0) => return Some(ErrorKind::UnexpectedEof.into()),
            Ok(length) => {
                heard = Instant::now();
                bytes.extend_from_slice(buffer.get(..length).unwrap_or_default());
                for received in take_frames(&mut bytes) {
                    if let Err(TrySendError::Disconnected(_)) = queue.try_send(received) {
                        return None;
                    }
                }
            }
            Err(error)
                if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted) => {}
            Err(error) => return Some(error),
        }
        if heard.elapsed() > SILENCE {
            return Some(std::io::Error::new(ErrorKind::TimedOut, "nothing came for 5 s, not even a heartbeat"));
        }
    }
}
