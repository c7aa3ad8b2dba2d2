//! `HttpExchange`: an HTTP request and its response, for an event loop.

use std::sync::{Arc, Mutex};

use bytes::Bytes;
use holdfast_engine::http::{Exchange, RequestHead, ResponseHead, Sent};
use holdfast_engine::server::Peer;
use holdfast_runtime::lock;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use pyo3::types::{PyBytes, PyTuple};

use crate::peer;

/// Names and values of headers.
pub type Headers = Vec<(PyBackedBytes, PyBackedBytes)>;

#[pyclass(frozen, module = "holdfast")]
pub struct HttpExchange {
    pub core: Arc<Exchange>,
    pub answers: Arc<Answers>,
}

#[pymethods]
impl HttpExchange {
    #[getter]
    fn number(&self) -> u64 {
        self.core.number
    }

    fn receive(&self, most: usize) {
        self.core.receive(most);
    }

    pub fn respond(
        &self,
        status: u16,
        headers: &Bound<'_, PyAny>,
        body: &[u8],
        closes: bool,
    ) -> PyResult<()> {
        let head = self.answers.head(status, headers)?;
        self.core.respond(head, Bytes::copy_from_slice(body), closes);
        Ok(())
    }

    fn begin(&self, status: u16, headers: Headers) -> PyResult<()> {
        self.core.begin(response_head(status, &headers)?);
        Ok(())
    }

    /// Whether the data were taken; `None` if the client is gone.
    fn send(&self, data: &[u8]) -> Option<bool> {
        match self.core.send(Bytes::copy_from_slice(data)) {
            Sent::Taken => Some(true),
            Sent::Full => Some(false),
            Sent::Gone => None,
        }
    }

    fn end(&self, is_complete: bool) {
        self.core.end(is_complete);
    }

    fn watch_client(&self) -> bool {
        self.core.watch_client()
    }

    /// Cuts off the connection, unless there has been a response.
    fn abandon(&self) {
        self.core.abandon();
    }
}

impl Drop for HttpExchange {
    fn drop(&mut self) {
        self.core.abandon();
    }
}

pub fn response_head(status: u16, headers: &Headers) -> PyResult<ResponseHead> {
    let headers = headers.iter().map(|(name, value)| (&name[..], &value[..]));
    ResponseHead::new(status, headers).map_err(|error| PyValueError::new_err(error.to_string()))
}

/// Exchange, head, peer, length of the body, body, and the identity of the client.
pub fn request<'py>(
    py: Python<'py>,
    exchange: HttpExchange,
    known: Bound<'py, PyTuple>,
    head: &RequestHead,
    body: Option<Bytes>,
) -> PyResult<Bound<'py, PyTuple>> {
    let peer = peer::text(&head.peer);
    let body = body.map(|body| PyBytes::new(py, &body));
    (exchange, known, peer, head.len, body, identity(&head.peer)).into_pyobject(py)
}

/// The head of the last response: most responses have the same one.
#[derive(Default)]
pub struct Answers(Mutex<Option<(Py<PyTuple>, ResponseHead)>>);

impl Answers {
    fn head(&self, status: u16, headers: &Bound<'_, PyAny>) -> PyResult<ResponseHead> {
        // Only a tuple can't have changed.
        let Ok(given) = headers.cast_exact::<PyTuple>() else {
            return response_head(status, &headers.extract::<Headers>()?);
        };
        let mut last = lock(&self.0);
        if let Some((of, ResponseHead { status: known, headers })) = &*last
            && of.is(given)
            && *known == status
        {
            return Ok(ResponseHead { status: *known, headers: headers.clone() });
        }
        let made = response_head(status, &given.extract::<Headers>()?)?;
        let copy = ResponseHead { status: made.status, headers: made.headers.clone() };
        *last = Some((given.clone().unbind(), copy));
        Ok(made)
    }
}

/// Subject, serial number and role of the certificate of a client.
fn identity(peer: &Peer) -> Option<(&str, &str, &str)> {
    let certificate = peer.certificate.as_ref()?;
    Some((&certificate.subject, &certificate.serial, &certificate.role))
}
