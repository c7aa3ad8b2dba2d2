//! `HttpServer` and `HttpExchange`: requests of HTTP, for an event loop.

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use holdfast_engine::http::{
    Event, Exchange, HttpServer as CoreServer, HttpSettings, Refusal, RefusalBody, RequestHead,
    ResponseHead, Sent, bind,
};
use holdfast_engine::server::{ConnectionLimits, Peer};
use holdfast_engine::tls::server::Protocol;
use pyo3::exceptions::{PyOSError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use pyo3::types::{PyBytes, PyDict, PyList, PyTuple};

use crate::arguments::{address, network, os_error, os_text, time_to_wait};
use crate::engine::{dict, event_fields};
use crate::heartbeat;
use crate::link::handle;
use crate::listener::limits;
use crate::peer;
use crate::server_tls::ServerTls;

/// Names and values of headers.
type Headers = Vec<(PyBackedBytes, PyBackedBytes)>;

/// A TCP socket that listens.
#[pyclass(frozen, module = "holdfast")]
pub struct ListeningSocket {
    socket: Mutex<Option<TcpListener>>,
}

#[pymethods]
impl ListeningSocket {
    #[new]
    fn new(bind_address: &str) -> PyResult<ListeningSocket> {
        let socket =
            bind(address(bind_address)?).map_err(|error| os_error(&error, os_text(&error)))?;
        Ok(ListeningSocket { socket: Mutex::new(Some(socket)) })
    }

    fn __enter__(this: PyRef<'_, Self>) -> PyRef<'_, Self> {
        this
    }

    #[pyo3(signature = (*_args))]
    fn __exit__(&self, _args: &Bound<'_, PyTuple>) {
        self.close();
    }

    /// The address and the port.
    fn getsockname(&self) -> PyResult<(String, u16)> {
        let address = self.with(TcpListener::local_addr)?;
        Ok((address.ip().to_string(), address.port()))
    }

    /// Stops listening, when the servers of the socket have ended too.
    fn close(&self) {
        self.socket.lock().unwrap_or_else(PoisonError::into_inner).take();
    }
}

impl ListeningSocket {
    fn with<T>(&self, get: impl Fn(&TcpListener) -> std::io::Result<T>) -> PyResult<T> {
        let socket = self.socket.lock().unwrap_or_else(PoisonError::into_inner);
        let socket = socket.as_ref();
        Ok(get(socket.ok_or_else(|| PyOSError::new_err("the socket is closed"))?)?)
    }
}

#[pyclass(frozen, module = "holdfast")]
pub struct HttpServer {
    core: CoreServer,
}

#[pymethods]
impl HttpServer {
    #[new]
    #[pyo3(signature = (name, socket, *, sources, max_connections, max_connections_per_source=None, when_full="refuse", grace, request_timeout, idle_timeout, leaving=false, tls=None, refusals))]
    #[allow(clippy::too_many_arguments, reason = "they are keywords in Python")]
    fn new(
        name: String,
        socket: PyRef<'_, ListeningSocket>,
        sources: Vec<String>,
        max_connections: i128,
        max_connections_per_source: Option<i128>,
        when_full: &str,
        grace: f64,
        request_timeout: f64,
        idle_timeout: f64,
        leaving: bool,
        tls: Option<PyRef<'_, ServerTls>>,
        refusals: Vec<(String, Headers, Vec<u8>)>,
    ) -> PyResult<HttpServer> {
        let limits = limits(max_connections, max_connections_per_source, when_full)?;
        let max_handshakes = tls.as_ref().map(|_| limits.max_connections);
        let settings = HttpSettings {
            name,
            socket: socket.with(TcpListener::try_clone)?,
            sources: sources.iter().map(|text| network(text)).collect::<PyResult<_>>()?,
            limits: ConnectionLimits {
                max_handshakes,
                grace: Duration::from_secs_f64(grace),
                ..limits
            },
            request_timeout: time_to_wait("request_timeout", request_timeout)?,
            idle_timeout: time_to_wait("idle_timeout", idle_timeout)?,
            leaving,
            tls: tls.map(|tls| tls.of(Protocol::Http)).transpose()?,
            refusals: bodies(&refusals)?,
        };
        Ok(HttpServer { core: CoreServer::new(settings)? })
    }

    /// Begins to serve, in a thread of its own.
    fn start(&self) -> PyResult<()> {
        Ok(self.core.start()?)
    }

    /// Takes the handle of the socket that becomes readable when there is something to take.
    fn detach(&self) -> PyResult<i64> {
        let wakes = self.core.wakes();
        Ok(handle(wakes.ok_or_else(|| PyRuntimeError::new_err("the socket has been detached"))?))
    }

    /// Takes new requests, and what has happened to others since.
    fn take<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyList>, Bound<'py, PyList>)> {
        let (requests, events) = (PyList::empty(py), PyList::empty(py));
        for event in self.core.take() {
            let (number, kind, value) = match event {
                Event::Request { exchange, head, body } => {
                    requests.append(request(py, exchange, &head, body)?)?;
                    continue;
                }
                Event::Body { number, body } => {
                    (number, "body", PyBytes::new(py, &body).into_any())
                }
                Event::Late { number, received } => {
                    (number, "late", received.into_pyobject(py)?.into_any())
                }
                Event::TooLarge { number } => (number, "too_large", py.None().into_bound(py)),
                Event::Broken { number } => (number, "broken", py.None().into_bound(py)),
                Event::Gone { number } => (number, "gone", py.None().into_bound(py)),
                Event::Room { number } => (number, "room", py.None().into_bound(py)),
            };
            events.append((number, kind, value))?;
        }
        Ok((requests, events))
    }

    /// Sends the responses since the last call.
    fn flush(&self) {
        self.core.flush();
    }

    /// Takes events of connections, as the fields of a log.
    fn events<'py>(&self, py: Python<'py>) -> PyResult<Vec<(&'static str, Bound<'py, PyDict>)>> {
        let mut events = Vec::new();
        while let Some(event) = self.core.event() {
            events.push((event.kind.name(), event_fields(py, &event)?));
        }
        Ok(events)
    }

    /// Counts of connections.
    fn counters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let counters = self.core.connections();
        let evicted = counters.evicted.get() + counters.evicted_handshakes.get();
        let counts = [
            ("accepted", counters.accepted.get()),
            ("refused_source", counters.refused_source.get()),
            ("refused_full", counters.refused_full.get()),
            ("evicted", evicted),
            ("idle", counters.idle.get()),
            ("request_timeout", counters.request_timeout.get()),
            ("slow_reader", counters.slow_reader.get()),
            ("broken_request", counters.broken_request.get()),
            ("tls_failed", counters.tls_failed.total()),
            ("open", self.core.open() as u64),
        ];
        dict(py, counts)
    }

    fn tls_failures(&self) -> BTreeMap<&'static str, u64> {
        self.core.connections().tls_failed.by_reason()
    }

    #[getter]
    fn open(&self) -> usize {
        self.core.open()
    }

    /// The name of the thread, seconds since its last beat, and the system's number of it.
    fn heartbeat(&self) -> (String, f64, Option<u32>) {
        heartbeat::shown(self.core.heartbeat())
    }

    fn set_tls(&self, tls: PyRef<'_, ServerTls>) -> PyResult<()> {
        self.core.set_tls(tls.of(Protocol::Http)?);
        Ok(())
    }

    /// Judges the certificates of open connections again.
    fn review(&self) {
        self.core.review();
    }

    fn end(&self) {
        self.core.end();
    }

    fn close(&self, py: Python<'_>) {
        py.detach(|| self.core.close());
    }
}

#[pyclass(frozen, module = "holdfast")]
pub struct HttpExchange {
    core: Arc<Exchange>,
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

    fn respond(&self, status: u16, headers: Headers, body: &[u8], closes: bool) -> PyResult<()> {
        let head = response_head(status, &headers)?;
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

    /// There will be no response: the connection is cut off.
    fn abandon(&self) {
        self.core.abandon();
    }
}

impl Drop for HttpExchange {
    fn drop(&mut self) {
        self.core.abandon();
    }
}

fn response_head(status: u16, headers: &Headers) -> PyResult<ResponseHead> {
    let headers = headers.iter().map(|(name, value)| (&name[..], &value[..]));
    ResponseHead::new(status, headers).map_err(|error| PyValueError::new_err(error.to_string()))
}

/// Exchange, method, path, query, headers, peer, version, body, and the identity of the client.
fn request<'py>(
    py: Python<'py>,
    exchange: Arc<Exchange>,
    head: &RequestHead,
    body: Option<Bytes>,
) -> PyResult<Bound<'py, PyTuple>> {
    let parts = &head.parts;
    let headers = PyList::empty(py);
    for (name, value) in &parts.headers {
        let name = PyBytes::new(py, name.as_str().as_bytes());
        headers.append((name, PyBytes::new(py, value.as_bytes())))?;
    }
    let version = if parts.version == CoreServer::HTTP_10 { "1.0" } else { "1.1" };
    let query = parts.uri.query().unwrap_or_default();
    let body = body.map(|body| PyBytes::new(py, &body));
    (
        HttpExchange { core: exchange },
        parts.method.as_str(),
        parts.uri.path(),
        PyBytes::new(py, query.as_bytes()),
        headers,
        peer::text(head.peer.address),
        version,
        body,
        identity(&head.peer),
    )
        .into_pyobject(py)
}

/// Subject, serial number and role of the certificate of a client.
fn identity(peer: &Peer) -> Option<(&str, &str, &str)> {
    let certificate = peer.certificate.as_ref()?;
    Some((&certificate.subject, &certificate.serial, &certificate.role))
}

/// The bodies of refusals, from their names, headers and bodies.
fn bodies(given: &[(String, Headers, Vec<u8>)]) -> PyResult<[RefusalBody; Refusal::ALL.len()]> {
    let mut bodies = <[RefusalBody; Refusal::ALL.len()]>::default();
    for refusal in Refusal::ALL {
        let found = given.iter().find(|(name, ..)| name == refusal.name());
        let (_, headers, body) = found
            .ok_or_else(|| PyValueError::new_err(format!("refusals has no {}", refusal.name())))?;
        let ResponseHead { headers, .. } = response_head(400, headers)?;
        bodies[refusal as usize] = RefusalBody { headers, body: Bytes::copy_from_slice(body) };
    }
    Ok(bodies)
}
