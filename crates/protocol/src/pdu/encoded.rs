//! An encoded request that owns its PDU.

use core::fmt;

use super::{Buffer, ExceptionCode, MAX_LEN, Request};

/// The PDU of a valid request: a server cannot refuse its form, quantity or values.
#[derive(Clone, PartialEq, Eq)]
pub struct EncodedRequest {
    pdu: Buffer,
    len: u8,
}

impl EncodedRequest {
    /// Encodes a request.
    pub fn new(request: &Request<'_>) -> EncodedRequest {
        let mut pdu = [0; MAX_LEN];
        let len = request.encode(&mut pdu);
        EncodedRequest { pdu, len: len as u8 }
    }

    /// Checks and copies a PDU that was encoded elsewhere.
    ///
    ///
    /// # Errors
    /// As [`Request::parse`].
    pub fn parse(encoded: &[u8]) -> Result<EncodedRequest, ExceptionCode> {
        Request::parse(encoded)?;
        let mut pdu = [0; MAX_LEN];
        let room = pdu.get_mut(..encoded.len()).ok_or(ExceptionCode::IllegalDataValue)?;
        room.copy_from_slice(encoded);
        Ok(EncodedRequest { pdu, len: encoded.len() as u8 })
    }

    /// The PDU, 1 to [`MAX_LEN`] bytes.
    #[inline]
    pub fn pdu(&self) -> &[u8] {
        &self.pdu[..usize::from(self.len)]
    }

    /// The request itself.
    #[inline]
    pub fn request(&self) -> Request<'_> {
        match Request::parse(self.pdu()) {
            Ok(request) => request,
            Err(code) => {
                unreachable!("an encoded request is valid, but parsing failed with {code}")
            }
        }
    }
}

impl fmt::Debug for EncodedRequest {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_tuple("EncodedRequest").field(&self.request()).finish()
    }
}
