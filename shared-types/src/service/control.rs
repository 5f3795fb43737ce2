//! `control`: what every service can be told.

use super::{Context, ServiceError};
use crate::bus::Server;
use crate::channel::ControlChannel;
use crate::messages::{ControlCommand, ControlReply};

pub(super) struct Control {
    server: Server<ControlChannel>,
    held: bool,
}

impl Control {
    pub(super) fn open(context: &Context) -> Result<Self, ServiceError> {
        Ok(Self { server: context.bus.server()?, held: false })
    }

    /// Obeys what has come for this service; true when it is asked to stop.
    pub(super) fn turn(&mut self, context: &Context, now_ns: u64) -> Result<bool, ServiceError> {
        let mut stop = false;
        while let Some(request) = self.server.receive(now_ns)? {
            let asked = *request.header();
            if asked.service != context.name.code() {
                continue;
            }
            let accepted = match ControlCommand::from_code(asked.command) {
                Some(ControlCommand::Stop) => {
                    stop = true;
                    true
                }
                Some(ControlCommand::LogLevel) => crate::logging::set_level(asked.argument),
                Some(ControlCommand::DebugHold) => {
                    self.held = asked.argument == 1;
                    true
                }
                None => false,
            };
            let reply = ControlReply { accepted: u32::from(accepted), service: context.name.code() };
            let to = request.address();
            drop(request);
            self.server.reply(now_ns, &to, &reply, &[])?;
        }
        Ok(stop)
    }

    /// Whether a debugger holds this service.
    pub(super) fn held(&self) -> bool {
        self.held
    }
}
