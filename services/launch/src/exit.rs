//! Exit codes, and errors that carry one.

use std::process::ExitCode;

use shared_types::folder::FolderError;
use shared_types::service::ServiceError;

/// How a command ends, as its exit code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Exit {
    /// Success; of a mission: landed with a usable model.
    Ok = 0,
    /// The mission or job failed.
    Failed = 1,
    /// Bad arguments or configuration (`EX_USAGE`).
    Usage = 64,
    /// Something needed is missing (`EX_UNAVAILABLE`).
    Missing = 69,
    /// An error of Vantage itself (`EX_SOFTWARE`).
    Internal = 70,
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}

/// An error with the exit code it ends the command with.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub struct Refusal {
    /// The exit code.
    pub exit: Exit,
    /// What is wrong: the file or key, the value found, what was expected, the way out.
    pub message: String,
}

impl Refusal {
    /// Bad arguments or configuration.
    pub fn usage(message: impl Into<String>) -> anyhow::Error {
        Self { exit: Exit::Usage, message: message.into() }.into()
    }

    /// Something needed is missing.
    pub fn missing(message: impl Into<String>) -> anyhow::Error {
        Self { exit: Exit::Missing, message: message.into() }.into()
    }

    /// The job failed.
    pub fn failed(message: impl Into<String>) -> anyhow::Error {
        Self { exit: Exit::Failed, message: message.into() }.into()
    }
}

/// The exit code of an error: its own if it carries one, else by what caused it.
#[must_use]
pub fn exit_of(error: &anyhow::Error) -> Exit {
    for cause in error.chain() {
        if let Some(refusal) = cause.downcast_ref::<Refusal>() {
            return refusal.exit;
        }
        if cause.is::<shared_types::config::ConfigError>() {
            return Exit::Usage;
        }
        if let Some(error) = cause.downcast_ref::<FolderError>() {
            return match error {
                FolderError::HoldsMission { .. } | FolderError::NoMission { .. } | FolderError::Exists { .. } => {
                    Exit::Usage
                }
                FolderError::Io { .. } | FolderError::Full { .. } => Exit::Missing,
                FolderError::Damaged { .. } => Exit::Failed,
            };
        }
        // Its own errors are shown as if they were the service's: they are not in the chain.
        match cause.downcast_ref::<ServiceError>() {
            Some(ServiceError::Bus(_) | ServiceError::Missing(_)) => return Exit::Missing,
            Some(ServiceError::Unusable(_)) => return Exit::Usage,
            Some(ServiceError::Other(_)) | None => {}
        }
        if cause.is::<shared_types::system::SystemError>() || cause.is::<shared_types::bus::BusError>() {
            return Exit::Missing;
        }
        if cause.is::<std::io::Error>() {
            return Exit::Missing;
        }
    }
    Exit::Internal
}

#[cfg(test)]
mod tests {
    use anyhow::Context as _;

    use super::*;

    #[test]
    fn an_error_keeps_its_exit_code_under_context() {
        let error: anyhow::Error =
            Err::<(), _>(Refusal::failed("no model")).context("evaluating").expect_err("refused");
        assert_eq!(exit_of(&error), Exit::Failed);
        let error = anyhow::Error::from(shared_types::config::preset("huge").expect_err("unknown")).context("loading");
        assert_eq!(exit_of(&error), Exit::Usage);
        assert_eq!(exit_of(&anyhow::anyhow!("a bug")), Exit::Internal);
        let service = |error: ServiceError| exit_of(&anyhow::Error::from(error).context("world cannot go on"));
        let bus = shared_types::bus::BusError::NoChunk { channel: "clock" };
        assert_eq!(service(ServiceError::Bus(bus)), Exit::Missing);
        assert_eq!(service(ServiceError::Missing("no room for the journal".to_owned())), Exit::Missing);
        assert_eq!(service(ServiceError::Unusable("rock.obj: no triangles".to_owned())), Exit::Usage);
        assert_eq!(service(ServiceError::Other("a bug".to_owned())), Exit::Internal);
    }
}
