//! Why a file can't be used. The caller puts the name of the file in front.

use std::io;

use redb::{CommitError, DatabaseError, StorageError, TableError, TransactionError};
use thiserror::Error;

/// Why a file can't be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FileError {
    #[error(
        "the file is damaged: {0}. Restore it from a backup; to start without its contents, move it away"
    )]
    Damaged(String),
    #[error("the file is in use by another process")]
    Locked,
    #[error("not a file of memories: {0}")]
    Foreign(String),
    #[error("the file is of a newer release: its format version is {found}, allowed: {allowed}")]
    Newer { found: u64, allowed: u64 },
    /// Something has put another file in the place of the one that is open.
    #[error(
        "another file is in its place. Move that one away, and the contents are written to a new file; \
         a start would load the other file"
    )]
    Replaced,
    /// The file is gone with its folder, or with the file system that was mounted there. Unless it is known
    /// that the file was removed, it may still be there, with all that was stored.
    #[error(
        "its folder is gone, or on another file system. Put the folder back, or mount its file system again"
    )]
    FolderGone { was_removed: bool },
    #[error("{0}")]
    Io(#[from] io::Error),
    /// The file does not fit the log of its memories.
    #[error("{0}")]
    OfLog(String),
    /// The memories can't be kept in one file.
    #[error("{0}")]
    Memories(String),
}

impl FileError {
    pub(super) fn damaged(what: impl Into<String>) -> FileError {
        FileError::Damaged(what.into())
    }
}

impl From<StorageError> for FileError {
    fn from(error: StorageError) -> FileError {
        match error {
            StorageError::Io(error) => match error.kind() {
                io::ErrorKind::InvalidData | io::ErrorKind::UnexpectedEof => {
                    FileError::Damaged(error.to_string())
                }
                _ => FileError::Io(error),
            },
            StorageError::Corrupted(what) => FileError::Damaged(what),
            other => FileError::Io(io::Error::other(other.to_string())),
        }
    }
}

impl From<DatabaseError> for FileError {
    fn from(error: DatabaseError) -> FileError {
        match error {
            DatabaseError::DatabaseAlreadyOpen => FileError::Locked,
            DatabaseError::Storage(error) => error.into(),
            DatabaseError::UpgradeRequired(version) => {
                FileError::Foreign(format!("a redb file of format {version}"))
            }
            other => FileError::Damaged(other.to_string()),
        }
    }
}

impl From<TransactionError> for FileError {
    fn from(error: TransactionError) -> FileError {
        match error {
            TransactionError::Storage(error) => error.into(),
            other => FileError::Io(io::Error::other(other.to_string())),
        }
    }
}

impl From<CommitError> for FileError {
    fn from(error: CommitError) -> FileError {
        match error {
            CommitError::Storage(error) => error.into(),
            other => FileError::Io(io::Error::other(other.to_string())),
        }
    }
}

impl From<TableError> for FileError {
    fn from(error: TableError) -> FileError {
        match error {
            TableError::Storage(error) => error.into(),
            other => FileError::Foreign(format!("a redb file of another program: {other}")),
        }
    }
}
