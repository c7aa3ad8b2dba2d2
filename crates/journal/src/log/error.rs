//! Why a log does not work.

use std::io;
use std::path::Path;
use std::time::Duration;

use thiserror::Error;

/// Why a log can't be used.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum LogError {
    /// A setting is wrong, or a file of the settings can't be used.
    #[error("{0}")]
    Settings(String),
    #[error("not caught up with the log within {} s: {last}", .within.as_secs_f64())]
    NoConnection { within: Duration, last: String },
    #[error(
        "the layout differs from that of the log: {0}: correct it, or begin a log with another name"
    )]
    Layout(String),
    #[error("{what} has version {found}, supported is {supported}: update this node")]
    Version { what: &'static str, found: u8, supported: u8 },
    #[error("{0}")]
    Snapshot(String),
    /// The stream is not the one that this node has applied.
    #[error("{0}")]
    Replaced(String),
    #[error("another process writes to the log as node {0:?}: names of nodes must be unique")]
    NameTaken(String),
    #[error("the log has the last possible start of node {0:?}: rename the node")]
    NameUsedUp(String),
    #[error(
        "the log has had {most} nodes, the most in its life, and {node:?} is not one of them: use the \
         name of a node that does not run any more, or begin a log with another name"
    )]
    TooManyNodes { node: String, most: usize },
    #[error(
        "the contents at sequence {sequence} have digest {found}, {other}: this node has applied \
         something wrongly"
    )]
    Differs { sequence: u64, found: String, other: String },
    #[error("the thread of the log could not be started: {0}")]
    Thread(String),
}

impl LogError {
    /// The kind, as one word.
    pub const fn kind(&self) -> &'static str {
        match self {
            LogError::Settings(_) => "settings",
            LogError::NoConnection { .. } => "no_connection",
            LogError::Layout(_) => "layout",
            LogError::Version { .. } => "version",
            LogError::Snapshot(_) => "snapshot",
            LogError::Replaced(_) => "replaced",
            LogError::NameTaken(_) | LogError::NameUsedUp(_) => "name_taken",
            LogError::TooManyNodes { .. } => "too_many_nodes",
            LogError::Differs { .. } => "differs",
            LogError::Thread(_) => "thread",
        }
    }

    pub(super) fn file(path: &Path, error: &io::Error) -> LogError {
        LogError::Settings(format!("{}: {error}", path.display()))
    }
}

/// Says which messages the stream lacks.
pub(super) fn missing(from: u64, to: u64) -> String {
    if from == to {
        format!("message {from} of the log is missing")
    } else {
        format!("messages {from} to {to} of the log are missing")
    }
}

/// Why a session with the servers ended.
#[derive(Debug)]
pub(super) enum End {
    /// The owner has stopped the log.
    Stopped,
    /// Something that passes: another session is tried.
    Lost(String),
    /// The log can't go on.
    Fatal(LogError),
}

impl From<LogError> for End {
    fn from(error: LogError) -> End {
        End::Fatal(error)
    }
}

impl End {
    /// The stream does not have messages that come next.
    pub(super) fn missing(from: u64, to: u64) -> End {
        let what = missing(from, to);
        End::Lost(format!("{what}: only a new snapshot of a node that has applied them helps"))
    }

    /// Adds what a server has said meanwhile.
    pub(super) fn because(self, said: Option<&str>) -> End {
        match (self, said) {
            (End::Lost(reason), Some(said)) => End::Lost(format!("{reason}: {said}")),
            (end, _) => end,
        }
    }

    pub(super) fn reason(self) -> String {
        match self {
            End::Stopped => "the log was stopped".to_owned(),
            End::Lost(reason) => reason,
            End::Fatal(error) => error.to_string(),
        }
    }

    /// What a server could not do for now.
    pub(super) fn lost(what: &str, error: impl std::fmt::Display) -> End {
        End::Lost(format!("{what}: {error}"))
    }
}
