//! Functions 20 and 21: records of files (V1.1b3, 6.14 and 6.15).

use core::ops::RangeInclusive;

use super::{Buffer, ExceptionCode, Registers, RequestError, limit};

/// Of each range in a request: reference type, file, record, number of records.
const HEAD_LEN: usize = 7;

/// The only reference type.
const REFERENCE_TYPE: u8 = 6;

/// Of each range in a reply: its length and the reference type.
const REPLY_HEAD_LEN: usize = 2;

/// The fewest bytes behind the byte count of a request: one range, of function 21 with one record.
const MIN_READ_BYTES: usize = HEAD_LEN;
const MIN_WRITE_BYTES: usize = HEAD_LEN + 2;

/// Records of a file, each of one register.
///
/// ```
/// use holdfast_protocol::pdu::{FileRange, RequestError};
///
/// let range = FileRange::new(4, 1, 2)?;
/// assert_eq!((range.file(), range.record(), range.quantity()), (4, 1, 2));
/// assert_eq!(FileRange::new(0, 1, 2), Err(RequestError::File));
/// assert_eq!(FileRange::new(4, 10_000, 2), Err(RequestError::Record(10_000)));
/// # Ok::<(), RequestError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct FileRange {
    file: u16,
    record: u16,
    quantity: u16,
}

impl FileRange {
    /// `quantity` records from `record` of a file. The end can be beyond the last record: the device
    /// decides which ones exist.
    ///
    /// # Errors
    /// [`RequestError::File`] for file 0, [`RequestError::Record`] for a record above
    /// [`limit::LAST_RECORD`], [`RequestError::Quantity`] unless `quantity` is 1 to
    /// [`limit::WRITE_RECORDS`]; function 20 reads at most [`limit::READ_RECORDS`].
    pub const fn new(file: u16, record: u16, quantity: u16) -> Result<FileRange, RequestError> {
        if file == 0 {
            Err(RequestError::File)
        } else if record > limit::LAST_RECORD {
            Err(RequestError::Record(record))
        } else if quantity == 0 || quantity > limit::WRITE_RECORDS {
            Err(RequestError::Quantity { found: quantity as usize, max: limit::WRITE_RECORDS })
        } else {
            Ok(FileRange { file, record, quantity })
        }
    }

    /// The number of the file, 1 or more.
    pub const fn file(self) -> u16 {
        self.file
    }

    /// The first record, 0 to [`limit::LAST_RECORD`].
    pub const fn record(self) -> u16 {
        self.record
    }

    /// How many records, 1 to [`limit::WRITE_RECORDS`].
    pub const fn quantity(self) -> u16 {
        self.quantity
    }

    const fn reply_len(self) -> usize {
        REPLY_HEAD_LEN + self.byte_len()
    }

    const fn byte_len(self) -> usize {
        self.quantity as usize * 2
    }

    const fn head(self) -> [u8; HEAD_LEN] {
        let [f0, f1] = self.file.to_be_bytes();
        let [r0, r1] = self.record.to_be_bytes();
        let [q0, q1] = self.quantity.to_be_bytes();
        [REFERENCE_TYPE, f0, f1, r0, r1, q0, q1]
    }

    /// Another reference type, file 0, a record that cannot exist and no records are addresses that do
    /// not exist (V1.1b3, figures 24 and 25).
    fn parse(head: [u8; HEAD_LEN]) -> Result<FileRange, ExceptionCode> {
        let [reference_type, f0, f1, r0, r1, q0, q1] = head;
        let word = |high, low| u16::from_be_bytes([high, low]);
        FileRange::new(word(f0, f1), word(r0, r1), word(q0, q1))
            .ok()
            .filter(|_| reference_type == REFERENCE_TYPE)
            .ok_or(ExceptionCode::IllegalDataAddress)
    }
}

/// The ranges that function 20 reads: as many as fit into a request, with records that fit into its
/// reply.
///
/// ```
/// use holdfast_protocol::pdu::{self, FileRange, FileRanges, Request, RequestError};
///
/// let mut room = [0; pdu::MAX_LEN];
/// let ranges = [FileRange::new(4, 1, 2)?, FileRange::new(3, 9, 2)?];
/// let request = Request::ReadFileRecord(FileRanges::pack(&ranges, &mut room)?);
/// let mut out = [0; pdu::MAX_LEN];
/// let len = request.encode(&mut out);
/// assert_eq!(out[..len], [20, 14, 6, 0, 4, 0, 1, 0, 2, 6, 0, 3, 0, 9, 0, 2]);
/// # Ok::<(), RequestError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct FileRanges<'a> {
    bytes: &'a [u8],
}

impl<'a> FileRanges<'a> {
    /// Packs ranges at the start of `room`.
    ///
    /// # Errors
    /// [`RequestError::Space`] if there are none, or if they or their records take more bytes than
    /// [`limit::READ_FILE_BYTES`].
    pub fn pack(
        ranges: &[FileRange],
        room: &'a mut Buffer,
    ) -> Result<FileRanges<'a>, RequestError> {
        let records = ranges.iter().map(|range| range.reply_len()).sum::<usize>();
        let len = ranges.len() * HEAD_LEN;
        checked(len.max(records), limit::READ_FILE_BYTES)?;
        for (place, range) in room.as_chunks_mut().0.iter_mut().zip(ranges) {
            *place = range.head();
        }
        Ok(FileRanges { bytes: &room[..len] })
    }

    pub(super) fn parse(body: &'a [u8]) -> Result<FileRanges<'a>, ExceptionCode> {
        let ranges = FileRanges { bytes: counted(body, MIN_READ_BYTES..=limit::READ_FILE_BYTES)? };
        let (heads, rest) = ranges.bytes.as_chunks();
        if !rest.is_empty() {
            return Err(ExceptionCode::IllegalDataValue);
        }
        for head in heads {
            FileRange::parse(*head)?;
        }
        checked(ranges.reply_len(), limit::READ_FILE_BYTES)
            .or(Err(ExceptionCode::IllegalDataValue))?;
        Ok(ranges)
    }

    /// The ranges, in order.
    pub fn iter(&self) -> impl Iterator<Item = FileRange> + use<'a> {
        let heads: &[[u8; HEAD_LEN]] = self.bytes.as_chunks().0;
        heads.iter().filter_map(|head| FileRange::parse(*head).ok())
    }

    pub(super) const fn as_bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// Bytes that a reply has behind its byte count.
    pub(super) fn reply_len(&self) -> usize {
        self.iter().map(FileRange::reply_len).sum()
    }

    /// Writes what a reply has behind its byte count. `fill` writes the records of each range.
    pub(super) fn reply(&self, mut room: &mut [u8], mut fill: impl FnMut(FileRange, &mut [u8])) {
        for range in self.iter() {
            let Some((own, rest)) = room.split_at_mut_checked(range.reply_len()) else { return };
            if let [len, reference_type, records @ ..] = own {
                (*len, *reference_type) = (records.len() as u8 + 1, REFERENCE_TYPE);
                fill(range, records);
            }
            room = rest;
        }
    }

    /// Whether a reply has exactly the records of these ranges behind its byte count, in this order.
    pub(super) fn are_answered_by(&self, mut rest: &[u8]) -> bool {
        for range in self.iter() {
            match rest {
                [len, REFERENCE_TYPE, tail @ ..]
                    if usize::from(*len) == range.byte_len() + 1
                        && tail.len() >= range.byte_len() =>
                {
                    rest = &tail[range.byte_len()..];
                }
                _ => return false,
            }
        }
        rest.is_empty()
    }
}

/// The answer to function 20: the records of each range that was asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FileAnswer<'a> {
    bytes: &'a [u8],
}

impl<'a> FileAnswer<'a> {
    pub(super) const fn new(bytes: &'a [u8]) -> FileAnswer<'a> {
        FileAnswer { bytes }
    }

    /// The records of each range, in the order of the request: one big-endian register each.
    pub fn iter(&self) -> impl Iterator<Item = &'a [u8]> + use<'a> {
        let mut rest = self.bytes;
        core::iter::from_fn(move || {
            let [len, _, tail @ ..] = rest else { return None };
            let (records, tail) = tail.split_at_checked(usize::from(*len).checked_sub(1)?)?;
            rest = tail;
            Some(records)
        })
    }
}

/// The ranges that function 21 writes, with their records.
///
/// ```
/// use holdfast_protocol::pdu::{self, FileRecords, Request, RequestError};
///
/// let mut room = [0; pdu::MAX_LEN];
/// let records = FileRecords::pack(&[(4, 7, &[0x06AF, 0x04BE])], &mut room)?;
/// let mut out = [0; pdu::MAX_LEN];
/// let len = Request::WriteFileRecord(records).encode(&mut out);
/// assert_eq!(out[..len], [21, 11, 6, 0, 4, 0, 7, 0, 2, 0x06, 0xAF, 0x04, 0xBE]);
/// # Ok::<(), RequestError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct FileRecords<'a> {
    bytes: &'a [u8],
}

impl<'a> FileRecords<'a> {
    /// Packs files, first records and records at the start of `room`.
    ///
    /// # Errors
    /// As [`FileRange::new`]; [`RequestError::Space`] if there are no ranges, or if they take more
    /// bytes than [`limit::WRITE_FILE_BYTES`].
    pub fn pack(
        ranges: &[(u16, u16, &[u16])],
        room: &'a mut Buffer,
    ) -> Result<FileRecords<'a>, RequestError> {
        let len = ranges.iter().map(|(.., records)| HEAD_LEN + records.len() * 2).sum();
        let mut at = 0;
        for (file, record, records) in ranges {
            let quantity = u16::try_from(records.len()).unwrap_or(u16::MAX);
            let range = FileRange::new(*file, *record, quantity)?;
            checked(len, limit::WRITE_FILE_BYTES)?;
            let end = at + HEAD_LEN + range.byte_len();
            let (head, data) = room[at..end].split_at_mut(HEAD_LEN);
            head.copy_from_slice(&range.head());
            super::pack_registers(records, data);
            at = end;
        }
        checked(len, limit::WRITE_FILE_BYTES)?;
        Ok(FileRecords { bytes: &room[..len] })
    }

    pub(super) fn parse(body: &'a [u8]) -> Result<FileRecords<'a>, ExceptionCode> {
        let records =
            FileRecords { bytes: counted(body, MIN_WRITE_BYTES..=limit::WRITE_FILE_BYTES)? };
        let mut rest = records.bytes;
        while !rest.is_empty() {
            let (_, _, tail) = next(rest)?;
            rest = tail;
        }
        Ok(records)
    }

    /// The ranges with their records, in order.
    pub fn iter(
        &self,
    ) -> impl Iterator<Item = (FileRange, Registers<'a, { limit::WRITE_RECORDS }>)> + use<'a> {
        let mut rest = self.bytes;
        core::iter::from_fn(move || {
            let (range, records, tail) = next(rest).ok()?;
            rest = tail;
            Some((range, records))
        })
    }

    pub(super) const fn as_bytes(&self) -> &'a [u8] {
        self.bytes
    }
}

type Written<'a> = (FileRange, Registers<'a, { limit::WRITE_RECORDS }>, &'a [u8]);

/// The first range with its records, and what follows.
fn next(bytes: &[u8]) -> Result<Written<'_>, ExceptionCode> {
    let (head, tail) = bytes.split_first_chunk().ok_or(ExceptionCode::IllegalDataValue)?;
    // A quantity that leaves the PDU is wrong in form.
    let len = usize::from(u16::from_be_bytes([head[5], head[6]])) * 2;
    let (data, tail) = tail.split_at_checked(len).ok_or(ExceptionCode::IllegalDataValue)?;
    let range = FileRange::parse(*head)?;
    let records = Registers::new(data).or(Err(ExceptionCode::IllegalDataAddress))?;
    Ok((range, records, tail))
}

/// Parses an allowed byte count, and exactly that many bytes.
fn counted(body: &[u8], allowed: RangeInclusive<usize>) -> Result<&[u8], ExceptionCode> {
    match body {
        [count, bytes @ ..]
            if usize::from(*count) == bytes.len() && allowed.contains(&bytes.len()) =>
        {
            Ok(bytes)
        }
        _ => Err(ExceptionCode::IllegalDataValue),
    }
}

const fn checked(found: usize, max: usize) -> Result<(), RequestError> {
    if 1 <= found && found <= max { Ok(()) } else { Err(RequestError::Space { found, max }) }
}
