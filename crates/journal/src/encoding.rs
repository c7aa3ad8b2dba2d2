//! Steps as bytes, so that a file or a log can hold them.
//!
//! An encoded step begins with its version. Numbers are little-endian. The number of bytes of a
//! range follows from its area and count. A file is area 4, followed by its number.

use std::sync::Arc;

use bytes::{Buf, TryGetError};
use holdfast_memory::{Access, Action, Area, Memory, Step, StepWrite, Tenure, Term};
use thiserror::Error;

/// The version that [`encode`] writes. Others are not decoded.
pub const VERSION: u8 = 1;

/// The number of a file as an area.
const FILE: u8 = Area::File(0).index() as u8;

/// Set in the number of an access that a lease and its term follow.
const UNDER_LEASE: u8 = 0x80;

/// In the order of their numbers.
const ACCESSES: [Access; 4] = [Access::Client, Access::Ingest, Access::Mirror, Access::Restore];

// The numbers of actions.
const WRITE: u8 = 0;
const MASK: u8 = 1;
const WRITE_THEN_READ: u8 = 2;

/// Why bytes are not a step for some memories.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum DecodeError {
    #[error("the version is {0}, supported is {VERSION}")]
    Version(u8),
    #[error("the bytes end within the step")]
    Short,
    #[error("{0} bytes follow the step")]
    Long(usize),
    #[error("{what} is {found}, which is not defined")]
    Unknown { what: &'static str, found: u8 },
    #[error("memory {0} does not exist")]
    Member(u16),
    #[error("{} {address} + {count} are outside memory {member}", area.name())]
    Range { member: u16, area: Area, address: u16, count: u32 },
    #[error("a mask applies to registers, not to {}", .0.name())]
    Mask(Area),
}

impl From<TryGetError> for DecodeError {
    fn from(_: TryGetError) -> DecodeError {
        DecodeError::Short
    }
}

/// Appends a step that is valid for its memories.
///
/// # Panics
/// The number of bytes of a range does not match its count.
pub fn encode(step: &Step, out: &mut Vec<u8>) {
    out.push(VERSION);
    let access = ACCESSES.iter().position(|access| *access == step.access);
    let access = access.expect("each access has a number") as u8;
    match step.tenure {
        None => out.push(access),
        Some(Tenure { lease, term: Term { epoch, since } }) => {
            out.push(access | UNDER_LEASE);
            for number in [lease, epoch, since] {
                out.extend_from_slice(&number.to_le_bytes());
            }
        }
    }
    match &step.action {
        Action::Write(writes) => {
            out.push(WRITE);
            for write in writes {
                encode_write(write, out);
            }
        }
        &Action::Mask { member, area, address, and_mask, or_mask } => {
            out.push(MASK);
            encode_place(member, area, address, out);
            out.extend_from_slice(&and_mask.to_le_bytes());
            out.extend_from_slice(&or_mask.to_le_bytes());
        }
        &Action::WriteThenRead { ref write, area, address, count } => {
            out.push(WRITE_THEN_READ);
            encode_place(write.member, area, address, out);
            out.extend_from_slice(&encoded_count(count).to_le_bytes());
            encode_write(write, out);
        }
    }
}

fn encode_write(write: &StepWrite, out: &mut Vec<u8>) {
    let StepWrite { member, area, address, count, ref bytes } = *write;
    assert_eq!(bytes.len(), area.byte_len(count), "the bytes of a range match its count");
    encode_place(member, area, address, out);
    out.extend_from_slice(&encoded_count(count).to_le_bytes());
    out.extend_from_slice(bytes);
}

fn encode_place(member: u16, area: Area, address: u16, out: &mut Vec<u8>) {
    out.extend_from_slice(&member.to_le_bytes());
    out.push(area.index() as u8);
    if let Area::File(number) = area {
        out.extend_from_slice(&number.to_le_bytes());
    }
    out.extend_from_slice(&address.to_le_bytes());
}

fn encoded_count(count: usize) -> u32 {
    u32::try_from(count).expect("a range is inside an area")
}

/// Whether an encoded step is under a lease.
pub(crate) fn is_under_lease(step: &[u8]) -> bool {
    step.get(1).is_some_and(|access| access & UNDER_LEASE != 0)
}

/// Decodes a step for these memories: all of its members exist, and hold its ranges.
///
/// # Errors
/// [`DecodeError`], for all other bytes.
pub fn decode(bytes: &[u8], members: &[Arc<Memory>]) -> Result<Step, DecodeError> {
    let mut rest = Rest { bytes, members };
    let version = rest.bytes.try_get_u8()?;
    if version != VERSION {
        return Err(DecodeError::Version(version));
    }
    let (access, tenure) = rest.writer()?;
    let action = match rest.bytes.try_get_u8()? {
        WRITE => {
            let mut writes = Vec::new();
            while !rest.bytes.is_empty() {
                writes.push(rest.write()?);
            }
            Action::Write(writes)
        }
        MASK => {
            let (member, area, address) = rest.place()?;
            if area.is_bits() {
                return Err(DecodeError::Mask(area));
            }
            rest.check_range((member, area, address), 1)?;
            let and_mask = rest.bytes.try_get_u16_le()?;
            let or_mask = rest.bytes.try_get_u16_le()?;
            Action::Mask { member, area, address, and_mask, or_mask }
        }
        WRITE_THEN_READ => {
            let place = rest.place()?;
            let count = rest.bytes.try_get_u32_le()?;
            rest.check_range(place, count)?;
            let write = rest.write()?;
            let (member, area, address) = place;
            if member != write.member {
                return Err(DecodeError::Member(member));
            }
            Action::WriteThenRead { write, area, address, count: count as usize }
        }
        found => return Err(DecodeError::Unknown { what: "the action", found }),
    };
    match rest.bytes.len() {
        0 => Ok(Step { access, tenure, action }),
        extra => Err(DecodeError::Long(extra)),
    }
}

/// Bytes that are not decoded yet.
struct Rest<'a> {
    bytes: &'a [u8],
    members: &'a [Arc<Memory>],
}

impl<'a> Rest<'a> {
    /// With which access a step was written, and under which lease.
    fn writer(&mut self) -> Result<(Access, Option<Tenure>), DecodeError> {
        let found = self.bytes.try_get_u8()?;
        let access = ACCESSES.get(usize::from(found & !UNDER_LEASE)).copied();
        let access = access.ok_or(DecodeError::Unknown { what: "the access", found })?;
        if found & UNDER_LEASE == 0 {
            return Ok((access, None));
        }
        let lease = self.bytes.try_get_u64_le()?;
        let epoch = self.bytes.try_get_u64_le()?;
        let term = Term { epoch, since: self.bytes.try_get_u64_le()? };
        Ok((access, Some(Tenure { lease, term })))
    }

    fn place(&mut self) -> Result<(u16, Area, u16), DecodeError> {
        let member = self.bytes.try_get_u16_le()?;
        let area = match self.bytes.try_get_u8()? {
            FILE => Area::File(self.bytes.try_get_u16_le()?),
            found => {
                let area = Area::ALL.get(usize::from(found)).copied();
                area.ok_or(DecodeError::Unknown { what: "the area", found })?
            }
        };
        Ok((member, area, self.bytes.try_get_u16_le()?))
    }

    fn check_range(
        &self,
        (member, area, address): (u16, Area, u16),
        count: u32,
    ) -> Result<(), DecodeError> {
        let memory = self.members.get(usize::from(member)).ok_or(DecodeError::Member(member))?;
        if count == 0 || !memory.span(area).holds(address, count as usize) {
            return Err(DecodeError::Range { member, area, address, count });
        }
        Ok(())
    }

    fn write(&mut self) -> Result<StepWrite, DecodeError> {
        let place = self.place()?;
        let count = self.bytes.try_get_u32_le()?;
        self.check_range(place, count)?;
        let (member, area, address) = place;
        let count = count as usize;
        let bytes =
            self.bytes.split_off(..area.byte_len(count)).ok_or(DecodeError::Short)?.to_vec();
        Ok(StepWrite { member, area, address, count, bytes })
    }
}
