//! `HttpServer`: requests of HTTP, for an event loop.

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::sync::{Arc, Mutex};

use bytes::Bytes;
use holdfast_engine::http::{
    Event, Exchange, HttpServer as CoreServer, HttpSettings, Refusal, RefusalBody, RequestHead,
    ResponseHead, bind,
};
use holdfast_engine::server::ConnectionLimits;
use holdfast_engine::tls::server::Protocol;
use holdfast_runtime::lock;
use pyo3::exceptions::{PyOSError, PyRuntimeError, PyValueError};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyBytes, PyDict, PyList, PyTuple};

use crate::arguments::{address, network, os_error, os_text, seconds, time_to_wait};
use crate::engine::event_fields;
use crate::exchange::{Answers, Headers, HttpExchange, request, response_head};
use crate::heartbeat;
use crate::json_commands::{Commands, ParsedWrite, ParsedWrites};
use crate::link::handle;
use crate::listener::limits;
use crate::request_heads::Heads;
use crate::server_tls::ServerTls;

/// The key under which a handler keeps, with a head, what parses the body and who takes the result.
const COMMANDS: &str = "commands";

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
        lock(&self.socket).take();
    }
}

impl ListeningSocket {
    fn with<T>(&self, get: impl Fn(&TcpListener) -> std::io::Result<T>) -> PyResult<T> {
        let socket = lock(&self.socket);
        let socket = socket.as_ref();
        Ok(get(socket.ok_or_else(|| PyOSError::new_err("the socket is closed"))?)?)
    }
}

#[pyclass(frozen, module = "holdfast")]
pub struct HttpServer {
    core: CoreServer,
    heads: Heads,
    answers: Arc<Answers>,
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
        let socket = socket.with(TcpListener::try_clone)?;
        let settings = HttpSettings {
            name,
            sources: sources.iter().map(|text| network(text)).collect::<PyResult<_>>()?,
            limits: ConnectionLimits { max_handshakes, grace: seconds("grace", grace)?, ..limits },
            request_timeout: time_to_wait("request_timeout", request_timeout)?,
            idle_timeout: time_to_wait("idle_timeout", idle_timeout)?,
            leaving,
            refusals: bodies(&refusals)?,
        };
        let tls = tls.map(|tls| tls.of(Protocol::Http)).transpose()?;
        Ok(HttpServer {
            core: CoreServer::new(settings, socket, tls)?,
            heads: Heads::default(),
            answers: Arc::default(),
        })
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

    /// Takes new requests, in batches of at most `most`, and what has happened to others since.
    fn take<'py>(
        &self,
        py: Python<'py>,
        most: usize,
    ) -> PyResult<(Vec<Bound<'py, PyList>>, Bound<'py, PyList>)> {
        let (mut requests, events) = (Vec::new(), PyList::empty(py));
        for event in self.core.take() {
            let (number, kind, value) = match event {
                Event::Request { exchange, head, body } => {
                    requests.push((exchange, head, body));
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
        let mut batches = Vec::new();
        let mut requests = requests.into_iter().peekable();
        while requests.peek().is_some() {
            batches.push(self.batch(py, requests.by_ref().take(most))?);
        }
        Ok((batches, events))
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
        counts.into_py_dict(py)
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
        heartbeat::to_python(self.core.heartbeat())
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

impl HttpServer {
    /// The requests of a batch, in their order. Commands that follow each other and have one handler are
    /// parsed here, and become one item.
    fn batch<'py>(
        &self,
        py: Python<'py>,
        requests: impl Iterator<Item = (Arc<Exchange>, Box<RequestHead>, Option<Bytes>)>,
    ) -> PyResult<Bound<'py, PyList>> {
        let items = PyList::empty(py);
        let mut parsed: Option<(Bound<'py, PyAny>, Vec<ParsedWrite>)> = None;
        for (core, head, body) in requests {
            let exchange = HttpExchange { core, answers: Arc::clone(&self.answers) };
            let (known, kept) = self.heads.of(py, &head.parts)?;
            let write = match (&body, kept.get_item(intern!(py, COMMANDS))?) {
                (Some(body), Some(given)) => {
                    let (commands, handler): (PyRef<'_, Commands>, _) = given.extract()?;
                    commands.parsed(py, body).map(|parsed| (handler, parsed))
                }
                _ => None,
            };
            let next = write.as_ref().map(|(handler, _): &(Bound<'py, PyAny>, _)| handler);
            let ends = |of: &Bound<'py, PyAny>| !next.is_some_and(|next| next.is(of));
            if let Some((handler, writes)) = parsed.take_if(|(handler, _)| ends(handler)) {
                items.append(ParsedWrites::new(handler.unbind(), writes))?;
            }
            match (write, body) {
                (Some((handler, (name, shown, batch))), Some(body)) => {
                    let known = known.unbind();
                    let (_, writes) = parsed.get_or_insert_with(|| (handler, Vec::new()));
                    writes.push(ParsedWrite { exchange, head, known, body, name, shown, batch });
                }
                (_, body) => items.append(request(py, exchange, known, &head, body)?)?,
            }
        }
        if let Some((handler, writes)) = parsed {
            items.append(ParsedWrites::new(handler.unbind(), writes))?;
        }
        Ok(items)
    }
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
