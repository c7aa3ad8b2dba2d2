//! An encoded request that owns its PDU.

use core::fmt;

use super::{Buffer, ExceptionCode, MAX_LEN, Request, Response, ResponseError};

/// The PDU of a request, ready to be sent: a valid one, or one that is passed on as it came.
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
    /// # Errors
    /// As [`Request::parse`].
    pub fn parse(encoded: &[u8]) -> Result<EncodedRequest, ExceptionCode> {
        Request::parse(encoded)?;
        EncodedRequest::opaque(encoded).ok_or(ExceptionCode::IllegalDataValue)
    }

    /// Copies a PDU of any function and form, for a gateway that leaves the judgement to the device.
    /// `None` unless it has 1 to [`MAX_LEN`] bytes, and its function code is below 128.
    ///
    /// ```
    /// use holdfast_protocol::pdu::{EncodedRequest, Response};
    ///
    /// let vendor = EncodedRequest::opaque(&[66, 1, 2]).unwrap();
    /// assert_eq!(vendor.request(), None);
    /// assert_eq!(vendor.response(&[66, 7]), Ok(Response::Opaque(&[7])));
    /// ```
    pub fn opaque(pdu: &[u8]) -> Option<EncodedRequest> {
        if pdu.first().is_none_or(|code| code & 0x80 != 0) {
            return None;
        }
        let mut copy = [0; MAX_LEN];
        copy.get_mut(..pdu.len())?.copy_from_slice(pdu);
        Some(EncodedRequest { pdu: copy, len: pdu.len() as u8 })
    }

    /// The PDU, 1 to [`MAX_LEN`] bytes.
    #[inline]
    pub fn pdu(&self) -> &[u8] {
        &self.pdu[..usize::from(self.len)]
    }

    /// The request itself; `None` for one of an unknown function, or that a server would refuse for
    /// its form, quantity or values.
    #[inline]
    pub fn request(&self) -> Option<Request<'_>> {
        Request::parse(self.pdu()).ok()
    }

    /// Whether the request is known to only read: repeating it changes nothing.
    pub fn is_read(&self) -> bool {
        self.request().is_some_and(|request| request.is_read())
    }

    /// Parses the PDU that answers this request. Of the answer to a request that is passed on as it
    /// came, only the function code is judged.
    ///
    /// # Errors
    /// As [`Request::response`].
    pub fn response<'p>(&self, pdu: &'p [u8]) -> Result<Response<'p>, ResponseError> {
        if let Some(request) = self.request() {
            return request.response(pdu);
        }
        let expected = self.pdu()[0];
        match pdu {
            [found, body @ ..] if *found == expected => Ok(Response::Opaque(body)),
            [found, code] if *found == expected | 0x80 => Err(ResponseError::exception(*code)),
            [found, ..] if *found | 0x80 != expected | 0x80 => {
                Err(ResponseError::Function { expected, found: *found })
            }
            _ => Err(ResponseError::Length),
        }
    }
}

impl fmt::Debug for EncodedRequest {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.request() {
            Some(request) => formatter.debug_tuple("EncodedRequest").field(&request).finish(),
            None => formatter.debug_tuple("EncodedRequest").field(&self.pdu()).finish(),
        }
    }
}
