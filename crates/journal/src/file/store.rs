//! The file as a database: its tables, and transactions.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex};
use std::time::{Instant, SystemTime};

use holdfast_runtime::lock;
use redb::{
    Builder, Database, ReadableDatabase, ReadableTable, TableDefinition, TableError,
    WriteTransaction,
};

use super::disk::Disk;
use super::error::FileError;
use super::image::{self, Changes, Image, NoteChange, Page, StoredMemory, page_key};
use super::status::Status;

/// The newest version of the format: a memory may have files.
pub const VERSION: u64 = 2;
/// The version of a file while no memory in it has had files: older programs read it.
const FIRST_VERSION: u64 = 1;

const ABOUT: TableDefinition<&str, u64> = TableDefinition::new("holdfast");
const FORMAT: &str = "format";
/// The record of each memory, by name, with its checksum.
const MEMORIES: TableDefinition<&str, &[u8]> = TableDefinition::new("memories");
/// Memory, area and number of a page; its bytes, with their checksum.
const PAGES: TableDefinition<(u16, u8, u16), &[u8]> = TableDefinition::new("pages");

/// What the log has noted whose contents the file has; with its checksum.
const LOG: TableDefinition<&str, &[u8]> = TableDefinition::new("log");
const NOTE: &str = "note";

/// redb keeps pages in memory, and the image is there already.
const CACHE_BYTES: usize = 1 << 20;

/// An open file.
#[derive(Debug)]
pub(super) struct Store {
    disk: Arc<dyn Disk>,
    database: Database,
    /// What the file contains, unless it is in doubt.
    image: Image,
    /// The last transaction failed: what the file contains is unknown.
    in_doubt: bool,
    status: Arc<Mutex<Status>>,
}

impl Store {
    /// Opens the file, or creates one without memories.
    ///
    /// # Errors
    /// As [`super::MemoryFile::open`].
    pub fn open(disk: Arc<dyn Disk>, status: Arc<Mutex<Status>>) -> Result<Store, FileError> {
        let (database, image) = match disk.size()? {
            Some(len) => {
                inspect(&*disk, len)?;
                guarded(|| {
                    let database = disk.open(&builder())?;
                    let image = contents(&database)?;
                    Ok((database, image))
                })?
            }
            None => (create(&*disk, &Image::default())?, Image::default()),
        };
        let store = Store { disk, database, image, in_doubt: false, status };
        store.update_status(|status| status.bytes = store.bytes());
        Ok(store)
    }

    pub fn image(&self) -> &Image {
        &self.image
    }

    /// Stores changes durably, in one transaction. If the file is gone or in doubt, writes all contents to a
    /// new one, even without changes.
    ///
    /// # Errors
    /// [`FileError`]. The image is unchanged then. After a transaction that failed, the next call writes a new
    /// file.
    pub fn store(&mut self, changes: Changes) -> Result<(), FileError> {
        let began = Instant::now();
        self.update_status(|status| status.busy_since = Some(began));
        let stored = self.try_store(changes);
        // After an I/O error, the file may be in its place.
        let is_away = stored.is_err()
            && !matches!(
                self.disk.is_in_place(),
                Ok(true) | Err(FileError::Io(_) | FileError::FolderGone { was_removed: false })
            );
        let bytes = self.bytes();
        self.update_status(|status| {
            (status.busy_since, status.is_away) = (None, is_away);
            status.failing = stored.as_ref().err().map(ToString::to_string);
            if let Ok(true) = stored {
                status.stored_at = Some(SystemTime::now());
                status.commits += 1;
                status.last_commit = began.elapsed();
                status.bytes = bytes;
            }
        });
        stored.map(drop)
    }

    /// Returns whether there was anything to store.
    fn try_store(&mut self, changes: Changes) -> Result<bool, FileError> {
        // A file that is gone is written anew. Another file in its place is an error: `FileError::Replaced`.
        let is_gone = !self.disk.is_in_place()?;
        // What follows may fail when the new file is in place already.
        self.in_doubt |= is_gone;
        if self.in_doubt {
            let mut image = self.image.clone();
            image.apply(changes);
            self.database = create(&*self.disk, &image)?;
            self.image = image;
            self.in_doubt = false;
            self.update_status(|status| status.recreated += u64::from(is_gone));
            return Ok(true);
        }
        if changes.is_empty() {
            return Ok(false);
        }
        // Also true if it panics.
        self.in_doubt = true;
        let transaction = self.database.begin_write()?;
        write(&transaction, &changes)?;
        transaction.commit()?;
        self.in_doubt = false;
        self.image.apply(changes);
        Ok(true)
    }

    /// Closes the file.
    ///
    /// # Errors
    /// [`FileError`], also if the last contents are not stored.
    pub fn close(mut self) -> Result<(), FileError> {
        self.store(Changes::default())?;
        Ok(self.database.close()?)
    }

    fn bytes(&self) -> u64 {
        self.disk.size().ok().flatten().unwrap_or_default()
    }

    fn update_status(&self, change: impl FnOnce(&mut Status)) {
        change(&mut lock(&self.status));
    }
}

/// Checks the file and returns what it contains, without changing it.
///
/// # Errors
/// As [`super::read`].
pub(super) fn inspect(disk: &dyn Disk, len: u64) -> Result<Image, FileError> {
    if len == 0 {
        return Err(FileError::damaged("it has 0 bytes"));
    }
    guarded(|| contents(&disk.open_unchanged(&builder())?))
}

fn builder() -> Builder {
    let mut builder = Database::builder();
    builder.set_cache_size(CACHE_BYTES).set_check_integrity_on_open(true);
    builder
}

/// A database that is damaged in ways that redb does not expect may panic in it.
fn guarded<T>(open: impl FnOnce() -> Result<T, FileError>) -> Result<T, FileError> {
    catch_unwind(AssertUnwindSafe(open))
        .unwrap_or_else(|_| Err(FileError::damaged("its structure is invalid")))
}

/// Writes a new file and puts it in place.
fn create(disk: &dyn Disk, image: &Image) -> Result<Database, FileError> {
    create_beside(disk, image).inspect_err(|_| disk.discard())
}

fn create_beside(disk: &dyn Disk, image: &Image) -> Result<Database, FileError> {
    let database = disk.create(&builder())?;
    let transaction = database.begin_write()?;
    transaction.open_table(ABOUT)?.insert(FORMAT, FIRST_VERSION)?;
    let memories = image.memories.clone();
    let note = image.note.clone().map_or(NoteChange::Keep, NoteChange::Set);
    write(&transaction, &Changes { memories, note, ..Changes::default() })?;
    transaction.commit()?;
    disk.install()?;
    Ok(database)
}

fn write(transaction: &WriteTransaction, changes: &Changes) -> Result<(), FileError> {
    let mut records = transaction.open_table(MEMORIES)?;
    let mut pages = transaction.open_table(PAGES)?;
    match &changes.note {
        NoteChange::Keep => {}
        NoteChange::Set(note) => {
            let note = with_checksum(NOTE.as_bytes(), note);
            transaction.open_table(LOG)?.insert(NOTE, &*note)?;
        }
        NoteChange::Remove => drop(transaction.open_table(LOG)?.remove(NOTE)?),
    }
    for (name, id) in &changes.removed {
        records.remove(&**name)?;
        pages.retain_in((*id, 0, 0)..=(*id, u8::MAX, u16::MAX), |_, _| false)?;
    }
    if changes.memories.iter().any(|stored| stored.layout.has_files()) {
        transaction.open_table(ABOUT)?.insert(FORMAT, VERSION)?;
    }
    for stored in &changes.memories {
        let record = image::encode(stored.id, &stored.layout);
        records.insert(&*stored.name, &*with_checksum(stored.name.as_bytes(), &record))?;
        pages.retain_in((stored.id, 0, 0)..=(stored.id, u8::MAX, u16::MAX), |_, _| false)?;
        for (area, number, bytes) in stored.pages() {
            let key = page_key(stored.id, area, number);
            pages.insert(key, &*with_checksum(&key_bytes(key), bytes))?;
        }
    }
    for Page { memory, area, number, bytes } in &changes.pages {
        let key = page_key(*memory, *area, *number);
        pages.insert(key, &*with_checksum(&key_bytes(key), bytes))?;
    }
    Ok(())
}

/// Reads all that a database contains, and checks it.
fn contents(database: &Database) -> Result<Image, FileError> {
    let transaction = database.begin_read()?;
    let about = match transaction.open_table(ABOUT) {
        Err(TableError::TableDoesNotExist(_)) => {
            return Err(FileError::Foreign("a redb file of another program".to_owned()));
        }
        about => about?,
    };
    match about.get(FORMAT)?.map(|version| version.value()) {
        Some(FIRST_VERSION..=VERSION) => {}
        Some(found) if found > VERSION => {
            return Err(FileError::Newer { found, allowed: VERSION });
        }
        _ => return Err(FileError::damaged("it has no format version")),
    }
    let mut memories: Vec<StoredMemory> = Vec::new();
    for entry in transaction.open_table(MEMORIES)?.iter()? {
        let (name, record) = entry?;
        let name = name.value();
        let record = checked(name.as_bytes(), record.value())
            .ok_or_else(|| FileError::damaged(format!("wrong checksum of memory {name}")))?;
        memories.push(image::decode(name, record)?);
    }
    memories.sort_by_key(|stored| stored.id);
    if memories.windows(2).any(|pair| pair[0].id == pair[1].id) {
        return Err(FileError::damaged("two memories have one number"));
    }
    let pages = transaction.open_table(PAGES)?;
    let mut entries = pages.iter()?;
    for stored in &mut memories {
        for (area, bytes) in (0..).zip(&mut stored.areas) {
            for (number, page) in (0..).zip(bytes.chunks_mut(image::PAGE_BYTES)) {
                let key = page_key(stored.id, area, number);
                let damaged =
                    |what| FileError::damaged(format!("{what} {number} of memory {}", stored.name));
                let Some(entry) = entries.next() else { return Err(damaged("there is no page")) };
                let (found, stored) = entry?;
                let stored = checked(&key_bytes(key), stored.value());
                match stored.filter(|stored| found.value() == key && stored.len() == page.len()) {
                    Some(stored) => page.copy_from_slice(stored),
                    None => return Err(damaged("wrong checksum of page")),
                }
            }
        }
    }
    if entries.next().is_some() {
        return Err(FileError::damaged("it has pages of no memory"));
    }
    let note = match transaction.open_table(LOG) {
        Err(TableError::TableDoesNotExist(_)) => None,
        log => log?.get(NOTE)?.map(|note| checked(NOTE.as_bytes(), note.value()).map(Vec::from)),
    };
    match note {
        Some(None) => Err(FileError::damaged("wrong checksum of the note of the log")),
        note => Ok(Image { memories, note: note.flatten() }),
    }
}

/// The bytes of a [`page_key`], for its checksum.
fn key_bytes((memory, area, number): (u16, u8, u16)) -> [u8; 5] {
    let ([a, b], [c, d]) = (memory.to_be_bytes(), number.to_be_bytes());
    [a, b, area, c, d]
}

/// Bytes, and the checksum of them and of their owner: the key at which they are stored.
fn with_checksum(owner: &[u8], bytes: &[u8]) -> Vec<u8> {
    let mut stored = bytes.to_vec();
    stored.extend(checksum(owner, bytes).to_be_bytes());
    stored
}

/// The bytes, if their checksum is right.
fn checked<'a>(owner: &[u8], stored: &'a [u8]) -> Option<&'a [u8]> {
    let (bytes, found) = stored.split_last_chunk()?;
    (checksum(owner, bytes) == u32::from_be_bytes(*found)).then_some(bytes)
}

fn checksum(owner: &[u8], bytes: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(owner);
    hasher.update(bytes);
    hasher.finalize()
}
