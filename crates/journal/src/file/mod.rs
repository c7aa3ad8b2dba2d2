//! A file that keeps the contents of memories over restarts.
//!
//! The rules this module keeps:
//!
//! * The file is always the contents of its memories at one moment: a transaction of redb stores whole
//!   steps, and several memories in one.
//! * With `sync` 0, a step is answered after the transaction that stores it, and the memories change
//!   between the two. A step that can't be stored changes nothing.
//! * What the layout of a memory lacks at a start is set aside in the same transaction, as a record of
//!   its own, until the layout has it again or it is released.
//! * What a log changes comes from the log: contents at one of its messages, with a note of the log that
//!   is stored with them. The file is never their journal.
//! * After an I/O error, the contents of the disk are unknown. So the next transaction writes a new file and
//!   puts it in the place of the old one.
//! * If the file is gone, a new one with all contents takes its place before a step is answered; but not if
//!   its folder or file system is gone. Another file that is there is never replaced: that is an error until
//!   it is gone.
//! * A file that is not entirely as it was stored is refused, and not changed. It is never replaced by
//!   an empty one.

mod before_reply;
mod disk;
mod error;
mod image;
mod memory_file;
mod overlay;
mod periodic;
mod queue;
mod shrunk_memory;
mod status;
mod store;

use std::path::Path;

pub use disk::{Disk, FileOnDisk};
pub use error::FileError;
pub use image::StoredMemory;
pub use memory_file::{Member, MemoryFile, Options};
pub use overlay::Overlay;
pub use periodic::CheckpointSource;
pub use queue::QueueLimits;
pub use shrunk_memory::release;
pub use status::Status;
pub use store::VERSION;

/// Checks a file and returns what it contains, without changing it: memories, and what was cut from
/// them ([`StoredMemory::set_aside_of`]).
///
/// # Errors
/// As [`MemoryFile::open`], and [`FileError::Io`] for a file that does not exist.
pub fn read(path: &Path) -> Result<Vec<StoredMemory>, FileError> {
    read_from(&FileOnDisk::new(path))
}

/// As [`read`], from any disk.
///
/// # Errors
/// As [`read`].
pub fn read_from(disk: &dyn Disk) -> Result<Vec<StoredMemory>, FileError> {
    match disk.size()? {
        Some(len) => Ok(store::inspect(disk, len)?.memories),
        None => Err(FileError::Io(std::io::ErrorKind::NotFound.into())),
    }
}
