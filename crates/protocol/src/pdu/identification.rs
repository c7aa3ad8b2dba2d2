//! Function 43 with MEI type 14, Read Device Identification (V1.1b3, 6.21).

#[cfg(feature = "alloc")]
use alloc::{boxed::Box, vec::Vec};

use super::ExceptionCode;
#[cfg(feature = "alloc")]
use super::{Buffer, Function};

pub(super) const MEI_TYPE: u8 = 14;

/// Individual and stream access to all three categories.
#[cfg(feature = "alloc")]
const CONFORMITY_LEVEL: u8 = 0x83;

/// Function, MEI type, read code, conformity, more follows, next object, number of objects.
const HEAD_LEN: usize = 7;

/// The longest value that fits into a reply, in bytes.
pub const MAX_VALUE_LEN: usize = super::MAX_LEN - HEAD_LEN - 2;

codes! {
    /// The objects to read: a category as a stream of objects, or one object.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
    ReadCode: u8 {
        /// Objects 0x00 to 0x02.
        Basic = 1, "basic device identification";
        /// Objects 0x00 to 0x7F.
        Regular = 2, "regular device identification";
        /// Objects 0x00 to 0xFF.
        Extended = 3, "extended device identification";
        Individual = 4, "one specific identification object";
    }
}

#[cfg(feature = "alloc")]
impl ReadCode {
    const fn last_object(self) -> u8 {
        match self {
            ReadCode::Basic => 0x02,
            ReadCode::Regular => 0x7F,
            ReadCode::Extended | ReadCode::Individual => 0xFF,
        }
    }
}

/// Why objects are not a valid identification.
#[cfg(feature = "alloc")]
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[cfg_attr(not(feature = "exhaustive"), non_exhaustive)]
pub enum ObjectError {
    /// An id occurs twice.
    #[error("object {0:#04x} occurs twice")]
    Twice(u8),
    /// A value is longer than [`MAX_VALUE_LEN`].
    #[error("object {id:#04x} has {len} bytes, at most {MAX_VALUE_LEN} are allowed")]
    TooLong {
        /// The object.
        id: u8,
        /// The length of its value, in bytes.
        len: usize,
    },
    /// A mandatory object, 0x00 to 0x02, is missing.
    #[error("mandatory object {0:#04x} is missing")]
    Missing(u8),
    /// The id is one of 0x07 to 0x7F.
    #[error("object {0:#04x} is reserved")]
    Reserved(u8),
}

/// The identification of one device: objects by id, with at least the mandatory 0x00 to 0x02.
/// Requires the feature `alloc`.
///
/// ```
/// use holdfast_protocol::pdu::identification::{Objects, ReadCode};
/// use holdfast_protocol::pdu::{self, Request, Response};
///
/// let objects = [(0x00, "Example Works"), (0x01, "P-12"), (0x02, "1.4")];
/// let objects = Objects::new(objects.map(|(id, value)| (id, value.as_bytes().into())))?;
///
/// // The server answers a request for the basic objects …
/// let mut pdu = [0; pdu::MAX_LEN];
/// let len = objects.reply(ReadCode::Basic, 0x00, &mut pdu)?;
///
/// // … and the client reads the answer.
/// let request = Request::ReadDeviceIdentification { code: ReadCode::Basic, object_id: 0x00 };
/// let Response::Identification(answer) = request.response(&pdu[..len])? else { unreachable!() };
/// assert_eq!(answer.iter().nth(1), Some((0x01, &b"P-12"[..])));
/// assert_eq!(answer.next, None);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[cfg(feature = "alloc")]
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Objects(Box<[(u8, Box<[u8]>)]>);

#[cfg(feature = "alloc")]
impl Objects {
    /// Objects by id, in any order.
    ///
    /// # Errors
    /// [`ObjectError`] when an id occurs twice or is reserved (0x07 to 0x7F), a mandatory object is
    /// missing, or a value is longer than [`MAX_VALUE_LEN`].
    pub fn new(objects: impl IntoIterator<Item = (u8, Box<[u8]>)>) -> Result<Objects, ObjectError> {
        let mut objects: Vec<_> = objects.into_iter().collect();
        objects.sort_by_key(|(id, _)| *id);
        for pair in objects.windows(2) {
            if let [(id, _), (next, _)] = pair
                && id == next
            {
                return Err(ObjectError::Twice(*id));
            }
        }
        for (id, value) in &objects {
            match (*id, value.len()) {
                (0x07..=0x7F, _) => return Err(ObjectError::Reserved(*id)),
                (id, len) if len > MAX_VALUE_LEN => return Err(ObjectError::TooLong { id, len }),
                _ => {}
            }
        }
        for id in 0x00..=0x02 {
            if !objects.iter().any(|(known, _)| *known == id) {
                return Err(ObjectError::Missing(id));
            }
        }
        Ok(Objects(objects.into_boxed_slice()))
    }

    /// The value of an object.
    pub fn get(&self, id: u8) -> Option<&[u8]> {
        self.0.iter().find(|(known, _)| *known == id).map(|(_, value)| value.as_ref())
    }

    /// Writes the reply at the start of `pdu` and returns its length. A stream holds as many
    /// objects as fit, and the reply contains the id of the next object. A stream from an unknown
    /// object starts at the first object.
    ///
    /// # Errors
    /// [`ExceptionCode::IllegalDataAddress`] for an unknown individual object.
    pub fn reply(
        &self,
        code: ReadCode,
        object_id: u8,
        pdu: &mut Buffer,
    ) -> Result<usize, ExceptionCode> {
        let from = self.0.iter().position(|(id, _)| *id == object_id && *id <= code.last_object());
        let (from, most) = match (code, from) {
            (ReadCode::Individual, None) => return Err(ExceptionCode::IllegalDataAddress),
            (ReadCode::Individual, Some(from)) => (from, 1),
            (_, from) => (from.unwrap_or(0), self.0.len()),
        };
        let asked = self.0.iter().skip(from).take(most);
        let asked = asked.take_while(|(id, _)| *id <= code.last_object());
        let (mut len, mut count, mut next) = (HEAD_LEN, 0, None);
        for (id, value) in asked {
            let Some(out) = pdu.get_mut(len..len + 2 + value.len()) else {
                next = Some(*id);
                break;
            };
            out[0] = *id;
            out[1] = value.len() as u8;
            out[2..].copy_from_slice(value);
            len += out.len();
            count += 1;
        }
        let more = if next.is_some() { 0xFF } else { 0x00 };
        let function = Function::EncapsulatedInterface.code();
        let head =
            [function, MEI_TYPE, code.code(), CONFORMITY_LEVEL, more, next.unwrap_or(0), count];
        pdu[..HEAD_LEN].copy_from_slice(&head);
        Ok(len)
    }
}

pub(super) fn parse_request(body: &[u8]) -> Result<(ReadCode, u8), ExceptionCode> {
    match body {
        [MEI_TYPE, code, object_id] => {
            let code = ReadCode::from_code(*code).ok_or(ExceptionCode::IllegalDataValue)?;
            Ok((code, *object_id))
        }
        [MEI_TYPE, ..] | [] => Err(ExceptionCode::IllegalDataValue),
        _ => Err(ExceptionCode::IllegalFunction),
    }
}

/// An answer of a device: some of its objects, and the id of the next one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Answer<'a> {
    /// The supported categories, 0x01 to 0x03; plus 0x80 with access to single objects.
    pub conformity_level: u8,
    /// The object to ask for next; `None` after the last.
    pub next: Option<u8>,
    objects: &'a [u8],
}

impl<'a> Answer<'a> {
    /// Parses the body of a reply, after the function code. `None` when it is malformed.
    pub(super) fn parse(asked: ReadCode, body: &'a [u8]) -> Option<Answer<'a>> {
        let [MEI_TYPE, code, conformity_level, more, next, count, objects @ ..] = body else {
            return None;
        };
        let next = match more {
            0x00 => None,
            0xFF => Some(*next),
            _ => return None,
        };
        let answer = Answer { conformity_level: *conformity_level, next, objects };
        let whole = answer.iter().map(|(_, value)| value.len() + 2).sum::<usize>() == objects.len();
        let counted = answer.iter().count() == usize::from(*count);
        (*code == asked.code() && whole && counted).then_some(answer)
    }

    /// The objects of this answer, as id and value.
    pub fn iter(&self) -> impl Iterator<Item = (u8, &'a [u8])> + use<'a> {
        let mut rest = self.objects;
        core::iter::from_fn(move || {
            let [id, len, tail @ ..] = rest else { return None };
            let (value, tail) = tail.split_at_checked(usize::from(*len))?;
            rest = tail;
            Some((*id, value))
        })
    }
}
