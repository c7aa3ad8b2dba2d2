//! TLS over a connection whose socket belongs to the caller; `TlsChannel`: the same for Python.

use std::sync::Mutex;

use holdfast_engine::client::Place;
use holdfast_engine::tls::client::ClientTls;
use holdfast_engine::tls::{Channel, TlsFailure};
use holdfast_runtime::lock;
use pyo3::exceptions::{PyOSError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::client::Endpoint;

/// Why TLS ended a connection, and whether the peer may have carried out what it was sent.
pub(crate) type Failed = (TlsFailure, bool);

/// The client side of TLS.
pub(crate) struct Tls {
    channel: Channel,
    /// Received data.
    pub(crate) plain: Vec<u8>,
    /// Bytes to send.
    pub(crate) out: Vec<u8>,
    /// Whether the handshake has succeeded.
    is_agreed: bool,
    /// Whether data has been received after the handshake.
    has_data: bool,
}

impl Tls {
    /// Starts TLS. The `ClientHello` is in `out`.
    pub(crate) fn new(tls: &ClientTls) -> Result<Tls, TlsFailure> {
        let mut channel = tls.channel().map_err(|error| TlsFailure::from(&error))?;
        let mut out = Vec::new();
        channel.send(&[], &mut out);
        Ok(Tls { channel, plain: Vec::new(), out, is_agreed: false, has_data: false })
    }

    pub(crate) fn is_handshaking(&self) -> bool {
        self.channel.is_handshaking()
    }

    pub(crate) fn has_ended(&mut self) -> bool {
        self.channel.has_ended()
    }

    /// Appends data to what is sent.
    pub(crate) fn send(&mut self, plain: &[u8]) {
        self.channel.send(plain, &mut self.out);
    }

    /// Announces the end.
    pub(crate) fn end(&mut self) {
        self.channel.end(&mut self.out);
    }

    /// Processes received bytes. Their data replaces `plain`.
    pub(crate) fn receive(&mut self, data: &[u8]) -> Result<(), Failed> {
        self.plain.clear();
        let received = self.channel.receive(data, &mut self.plain, &mut self.out);
        self.is_agreed |= !self.channel.is_handshaking();
        self.has_data |= !self.plain.is_empty();
        received.map_err(|error| {
            let failure = TlsFailure::from(&error);
            let maybe_sent = self.is_agreed && !failure.refuses_connection();
            (failure, maybe_sent)
        })
    }

    /// Interprets the end of the connection; `None` if TLS has nothing to do with it.
    pub(crate) fn lost(&self, is_broken: bool) -> Option<Failed> {
        if self.channel.is_handshaking() {
            Some((TlsFailure::ClosedDuringHandshake, false))
        } else if is_broken && !self.has_data {
            Some((TlsFailure::ClosedBeforeReply, true))
        } else {
            None
        }
    }
}

#[pyclass(frozen, module = "holdfast")]
pub struct TlsChannel {
    tls: Mutex<Tls>,
}

/// Reason, text, and whether the peer may have carried out what it was sent.
type FailureFields = (&'static str, String, bool);

#[pymethods]
impl TlsChannel {
    #[new]
    fn new(endpoint: PyRef<'_, Endpoint>) -> PyResult<TlsChannel> {
        let Place::Tcp { tls: Some(tls), .. } = &endpoint.core.place else {
            return Err(PyValueError::new_err("endpoint is not one of TLS"));
        };
        let tls = Tls::new(tls).map_err(|failure| PyOSError::new_err(failure.to_string()))?;
        Ok(TlsChannel { tls: Mutex::new(tls) })
    }

    /// Whether the handshake is complete.
    #[getter]
    fn is_ready(&self) -> bool {
        !lock(&self.tls).is_handshaking()
    }

    /// Whether the peer has announced the end.
    #[getter]
    fn has_ended(&self) -> bool {
        lock(&self.tls).has_ended()
    }

    /// Encrypts data. During the handshake, it is queued until the end of the handshake.
    fn send(&self, data: &[u8]) {
        lock(&self.tls).send(data);
    }

    /// Takes the bytes to send now.
    fn outgoing<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        let mut tls = lock(&self.tls);
        let bytes = PyBytes::new(py, &tls.out);
        tls.out.clear();
        bytes
    }

    /// Processes received bytes. Returns their data, and why TLS has failed, if it has.
    fn receive<'py>(
        &self,
        py: Python<'py>,
        data: &[u8],
    ) -> (Bound<'py, PyBytes>, Option<FailureFields>) {
        let mut tls = lock(&self.tls);
        let failure = tls.receive(data).err().map(fields_of);
        (PyBytes::new(py, &tls.plain), failure)
    }

    /// Announces the end.
    fn end(&self) {
        lock(&self.tls).end();
    }

    /// Interprets the end of the connection; `None` if TLS has nothing to do with it.
    fn lost(&self, broken: bool) -> Option<FailureFields> {
        lock(&self.tls).lost(broken).map(fields_of)
    }
}

fn fields_of((failure, maybe_sent): Failed) -> FailureFields {
    (failure.reason(), failure.to_string(), maybe_sent)
}
