//! Where a file is, and how another one takes its place.

use std::fmt;
use std::fs;
use std::hash::{BuildHasher, RandomState};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use holdfast_runtime::lock;
use redb::backends::FileBackend;
use redb::{Builder, Database};

use super::error::FileError;
use super::overlay::Overlay;

/// A place for one file.
pub trait Disk: fmt::Debug + Send + Sync {
    /// The number of bytes of the file; `None` if there is no file.
    ///
    /// # Errors
    /// [`FileError::Io`], and [`FileError::Foreign`] for a directory, a device, or a symbolic link to
    /// nothing.
    fn size(&self) -> Result<Option<u64>, FileError>;

    /// Opens the file, which exists.
    ///
    /// # Errors
    /// Those of redb.
    fn open(&self, builder: &Builder) -> Result<Database, FileError>;

    /// Opens the file such that nothing in it changes.
    ///
    /// # Errors
    /// Those of redb.
    fn open_unchanged(&self, builder: &Builder) -> Result<Database, FileError>;

    /// Creates an empty database beside the file.
    ///
    /// # Errors
    /// Those of redb.
    fn create(&self, builder: &Builder) -> Result<Database, FileError>;

    /// Whether the file that was opened or installed last is still there; `false` if there is no file.
    ///
    /// # Errors
    /// [`FileError::Replaced`] if another file is there, [`FileError::FolderGone`], and as [`Disk::size`].
    fn is_in_place(&self) -> Result<bool, FileError>;

    /// Puts what was created in the place of the file, durably. A file that is not the one that was opened
    /// or installed last is never replaced.
    ///
    /// # Errors
    /// As [`Disk::is_in_place`], and [`FileError::Locked`] if another process has created a file meanwhile.
    /// The file is the old one or the new one then.
    fn install(&self) -> Result<(), FileError>;

    /// Removes what was created, unless it is in place.
    fn discard(&self);
}

const MAGIC: &[u8] = b"redb";

/// A file of the file system.
#[derive(Debug)]
pub struct FileOnDisk {
    path: PathBuf,
    /// Is created first. Its name is random: two that start at once never share it. The number of the process
    /// would be the same in all containers that use the folder.
    beside: PathBuf,
    opened: Mutex<Option<Opened>>,
}

/// The file that was opened or installed last.
#[derive(Debug)]
struct Opened {
    /// While this is open, no other file has its number.
    file: fs::File,
    /// Its file system is compared, because that of a file may have another number, as on overlayfs.
    folder: fs::Metadata,
}

impl FileOnDisk {
    pub fn new(path: &Path) -> FileOnDisk {
        // A link to the file stays one when another file takes its place.
        let path = fs::canonicalize(path).or_else(|_| std::path::absolute(path));
        let path = path.unwrap_or_default();
        let mut beside = path.as_os_str().to_owned();
        beside.push(format!(".{}.new", RandomState::new().hash_one(())));
        FileOnDisk { path, beside: beside.into(), opened: Mutex::default() }
    }

    /// Removes files beside this one, left by processes that were killed while they created them. A process
    /// that creates one now does not have this file open, and fails.
    fn sweep(&self) {
        let Some(name) = self.path.file_name() else { return };
        let prefix = format!("{}.", name.to_string_lossy());
        for entry in fs::read_dir(self.folder()).into_iter().flatten().flatten() {
            let found = entry.file_name();
            let number = found.to_str().and_then(|found| found.strip_prefix(&*prefix));
            let number = number.and_then(|rest| rest.strip_suffix(".new"));
            if number.is_some_and(|number| number.parse::<u64>().is_ok()) {
                let _ = fs::remove_file(entry.path());
            }
        }
    }

    /// The first bytes of the file.
    fn begin(&self) -> io::Result<Vec<u8>> {
        let mut begin = Vec::new();
        fs::File::open(&self.path)?.take(MAGIC.len() as u64).read_to_end(&mut begin)?;
        Ok(begin)
    }

    /// What is at the path; `None` if there is nothing.
    fn found(&self) -> Result<Option<fs::Metadata>, FileError> {
        let found = match fs::metadata(&self.path) {
            Ok(found) => found,
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                // A new file here would be empty, in the place of one that was moved or is not mounted.
                return match fs::read_link(&self.path) {
                    Ok(target) => Err(FileError::Foreign(format!(
                        "a symbolic link to {}, which does not exist. Put that file back; to start \
                         without its contents, remove the link",
                        target.display()
                    ))),
                    Err(_) => Ok(None),
                };
            }
            Err(error) => return Err(error.into()),
        };
        if !found.is_file() {
            let what = if found.is_dir() { "a directory" } else { "not a regular file" };
            return Err(FileError::Foreign(what.to_owned()));
        }
        Ok(Some(found))
    }

    fn folder(&self) -> &Path {
        let folder = self.path.parent().filter(|folder| !folder.as_os_str().is_empty());
        folder.unwrap_or(Path::new("."))
    }

    #[cfg(unix)]
    fn sync_folder(&self) -> io::Result<()> {
        fs::File::open(self.folder())?.sync_all()
    }

    /// Windows has no way to sync a folder.
    #[cfg(not(unix))]
    fn sync_folder(&self) -> io::Result<()> {
        Ok(())
    }
}

impl Disk for FileOnDisk {
    fn size(&self) -> Result<Option<u64>, FileError> {
        Ok(self.found()?.map(|found| found.len()))
    }

    fn open(&self, builder: &Builder) -> Result<Database, FileError> {
        // First, so that a file that takes its place in between is noticed as another one.
        let folder = fs::metadata(self.folder())?;
        let opened = Opened { file: fs::File::open(&self.path)?, folder };
        let database = builder.open(&self.path)?;
        *lock(&self.opened) = Some(opened);
        self.sweep();
        Ok(database)
    }

    fn open_unchanged(&self, builder: &Builder) -> Result<Database, FileError> {
        // On Windows, a file that is locked can't be read. Then redb finds the lock.
        if let Ok(begin) = self.begin()
            && begin != MAGIC
        {
            return Err(FileError::Foreign(format!("it begins with {}", begin.escape_ascii())));
        }
        // Locks the file: fails with `DatabaseAlreadyOpen`, which is `FileError::Locked`, if another process has it.
        let file = FileBackend::new(fs::File::open(&self.path)?)?;
        Ok(builder.create_with_backend(Overlay::new(file))?)
    }

    fn create(&self, builder: &Builder) -> Result<Database, FileError> {
        match fs::remove_file(&self.beside) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error.into()),
            _ => {}
        }
        Ok(builder.create(&self.beside)?)
    }

    fn is_in_place(&self) -> Result<bool, FileError> {
        let found = self.found()?;
        let opened = lock(&self.opened);
        let Some(Opened { file, folder }) = &*opened else {
            return if found.is_none() { Ok(false) } else { Err(FileError::Locked) };
        };
        let Some(found) = found else {
            // A mount point that is empty has no file either, but that is back with its file system.
            return match fs::metadata(self.folder()) {
                Ok(found) if is_on_same_file_system(folder, &found) => Ok(false),
                _ => Err(FileError::FolderGone { was_removed: was_removed(file) }),
            };
        };
        match file.metadata() {
            Ok(opened) if is_same(&opened, &found) => Ok(true),
            // NFS may know nothing more of a file that is gone.
            Err(error) if error.kind() != io::ErrorKind::StaleNetworkFileHandle => {
                Err(error.into())
            }
            _ => Err(FileError::Replaced),
        }
    }

    fn install(&self) -> Result<(), FileError> {
        let folder = fs::metadata(self.folder())?;
        let created = Opened { file: fs::File::open(&self.beside)?, folder };
        // NFS may know nothing more of a file that is gone.
        if let Some(Ok(old)) = lock(&self.opened).as_ref().map(|opened| opened.file.metadata()) {
            fs::set_permissions(&self.beside, old.permissions())?;
        }
        if self.is_in_place()? {
            fs::rename(&self.beside, &self.path)?;
        } else {
            // Unlike a rename, a link never replaces the file of another process.
            match fs::hard_link(&self.beside, &self.path) {
                // If the removal fails, the next process does it.
                Ok(()) => drop(fs::remove_file(&self.beside)),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                    return Err(FileError::Locked);
                }
                // Not every file system has links.
                Err(_) => fs::rename(&self.beside, &self.path)?,
            }
        }
        // It is there, also if the folder can't be synced.
        *lock(&self.opened) = Some(created);
        Ok(self.sync_folder()?)
    }

    fn discard(&self) {
        // Usually it is in place or was never created.
        let _ = fs::remove_file(&self.beside);
    }
}

#[cfg(unix)]
fn is_same(one: &fs::Metadata, other: &fs::Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    (one.dev(), one.ino()) == (other.dev(), other.ino())
}

#[cfg(unix)]
fn is_on_same_file_system(one: &fs::Metadata, other: &fs::Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    one.dev() == other.dev()
}

/// Whether no folder has the file any more. A file that can't be asked may still be somewhere.
#[cfg(unix)]
fn was_removed(file: &fs::File) -> bool {
    use std::os::unix::fs::MetadataExt;
    file.metadata().is_ok_and(|found| found.nlink() == 0)
}

/// The standard library does not show the number of a file on Windows.
#[cfg(not(unix))]
fn is_same(_: &fs::Metadata, _: &fs::Metadata) -> bool {
    true
}

/// Nor how many names a file has.
#[cfg(not(unix))]
fn was_removed(_: &fs::File) -> bool {
    false
}

/// Nor the number of a file system.
#[cfg(not(unix))]
fn is_on_same_file_system(_: &fs::Metadata, _: &fs::Metadata) -> bool {
    true
}
