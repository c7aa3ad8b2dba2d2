//! An encoded request that owns its PDU.

use core::fmt;

use super::response::body;
use super::{Bits, Buffer, ExceptionCode, MAX_LEN, Registers, Request, Response, ResponseError};

/// The PDU of a request, ready to be sent: a valid one, or one that is passed on as it came.
#[derive(Clone, PartialEq, Eq)]
pub struct EncodedRequest {
    pdu: Buffer,
    len: u8,
    /// Whether its response is [`Response::Opaque`].
    is_opaque: bool,
}

impl EncodedRequest {
    /// Encodes a request.
    pub fn new(request: &Request<'_>) -> EncodedRequest {
        let mut pdu = [0; MAX_LEN];
        let len = request.encode(&mut pdu);
        EncodedRequest { pdu, len: len as u8, is_opaque: false }
    }

    /// Checks and copies a PDU that was encoded elsewhere.
    ///
    /// # Errors
    /// As [`Request::parse`].
    pub fn parse(encoded: &[u8]) -> Result<EncodedRequest, ExceptionCode> {
        Request::parse(encoded)?;
        let opaque = EncodedRequest::opaque(encoded).ok_or(ExceptionCode::IllegalDataValue)?;
        Ok(EncodedRequest { is_opaque: false, ..opaque })
    }

    /// Copies a PDU of any function and form, for a gateway that leaves the judgement to the device,
    /// or for a function of a device's own. Its response is [`Response::Opaque`]. `None` unless the PDU
    /// has 1 to [`MAX_LEN`] bytes, and its function code is below 128.
    ///
    /// ```
    /// use holdfast_protocol::pdu::{EncodedRequest, Response};
    ///
    /// let vendor = EncodedRequest::opaque(&[66, 1, 2]).unwrap();
    /// assert_eq!(vendor.request(), None);
    /// assert_eq!(vendor.response(&[66, 7]), Ok(Response::Opaque(&[7])));
    ///
    /// let known = EncodedRequest::opaque(&[3, 0, 9, 0, 1]).unwrap();
    /// assert_eq!(known.response(&[3, 2, 0, 7]), Ok(Response::Opaque(&[2, 0, 7])));
    /// assert!(known.response(&[3, 4, 0, 7, 0, 8]).is_err());
    /// ```
    pub fn opaque(pdu: &[u8]) -> Option<EncodedRequest> {
        if pdu.first().is_none_or(|code| code & 0x80 != 0) {
            return None;
        }
        let mut copy = [0; MAX_LEN];
        copy.get_mut(..pdu.len())?.copy_from_slice(pdu);
        Some(EncodedRequest { pdu: copy, len: pdu.len() as u8, is_opaque: true })
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

    /// The same write with function 15 or 16, if this is one of a single coil or register (V1.1b3, 6.11,
    /// 6.12). `None` for any other request, and for one that is passed on as it came.
    ///
    /// ```
    /// use holdfast_protocol::pdu::{EncodedRequest, Request};
    ///
    /// let single = EncodedRequest::new(&Request::WriteSingleRegister { address: 7, value: 0x1234 });
    /// let multiple = single.as_multiple().unwrap();
    /// assert_eq!(multiple.pdu(), [16, 0, 7, 0, 1, 2, 0x12, 0x34]);
    /// assert!(multiple.as_multiple().is_none());
    /// ```
    pub fn as_multiple(&self) -> Option<EncodedRequest> {
        if self.is_opaque {
            return None;
        }
        let mut room = [0; MAX_LEN];
        let multiple = match self.request()? {
            Request::WriteSingleCoil { address, value } => {
                let bits = Bits::pack(&[value], &mut room).ok()?;
                Request::WriteMultipleCoils { address, bits }
            }
            Request::WriteSingleRegister { address, value } => {
                let registers = Registers::pack(&[value], &mut room).ok()?;
                Request::WriteMultipleRegisters { address, registers }
            }
            _ => return None,
        };
        Some(EncodedRequest::new(&multiple))
    }

    /// Whether the request is known to only read: repeating it changes nothing.
    pub fn is_read(&self) -> bool {
        self.request().is_some_and(|request| request.is_read())
    }

    /// Parses the PDU that answers this request. Of the answer to a request that a server would refuse,
    /// only the function code is judged.
    ///
    /// # Errors
    /// As [`Request::response`].
    pub fn response<'p>(&self, pdu: &'p [u8]) -> Result<Response<'p>, ResponseError> {
        if let Some(request) = self.request() {
            let response = request.response(pdu)?;
            return Ok(if self.is_opaque { Response::Opaque(&pdu[1..]) } else { response });
        }
        body(pdu, self.pdu()[0]).map(Response::Opaque)
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
