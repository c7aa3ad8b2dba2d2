//! `Connection`: the client side of a TCP connection, with or without TLS. The caller owns the
//! socket.

use std::hash::{BuildHasher, RandomState};
use std::io;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use holdfast_engine::client::{ClientError, Lost, Place};
use holdfast_engine::tls::TlsFailure;
use holdfast_protocol::client::{
    Attempt as CoreAttempt, Closed, Connection as Core, Done, Failure, Ticket, Transport,
};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::arguments::{byte, seconds};
use crate::channel::Tls;
use crate::client::{Endpoint, Reply, Request, exception, raised};

#[pyclass(frozen, module = "holdfast")]
pub struct Connection {
    state: Mutex<State>,
    /// The URL of the peer.
    to: String,
}

struct State {
    core: Core,
    tls: Option<Tls>,
    /// Why I/O or TLS ended the connection.
    ending: Option<Ending>,
}

/// A request that failed may be sent again.
#[pyclass(frozen, module = "holdfast")]
pub struct Attempt {
    core: CoreAttempt,
}

#[pymethods]
impl Attempt {
    /// Seconds to wait before.
    #[getter]
    fn pause(&self) -> f64 {
        self.core.pause().as_secs_f64()
    }

    /// Whether its timeout begins anew.
    #[getter]
    fn has_own_timeout(&self) -> bool {
        self.core.has_own_timeout()
    }
}

enum Ending {
    /// The flag says whether the peer may have carried out a request.
    Tls(TlsFailure, bool),
    Io(String),
}

/// Tickets of completed requests, each with a result or an exception.
type Completed<'py> = Vec<(u64, Bound<'py, PyAny>)>;

#[pymethods]
impl Connection {
    #[new]
    #[pyo3(signature = (endpoint, now, last=None))]
    fn new(
        endpoint: PyRef<'_, Endpoint>,
        now: f64,
        last: Option<PyRef<'_, Connection>>,
    ) -> PyResult<Connection> {
        let Place::Tcp { tls, .. } = &endpoint.core.place else {
            return Err(PyValueError::new_err("endpoint is not one of TCP or TLS"));
        };
        let to = endpoint.core.to_string();
        let tls = match tls {
            None => None,
            Some(tls) => Some(Tls::new(tls).map_err(|failure| {
                raised(ClientError::Tls { to: to.clone(), failure, maybe_sent: false })
            })?),
        };
        let now = clock(now)?;
        let core = Core::tolerant(Transport::Tcp, endpoint.core.tolerance, now);
        // The keys of a hasher are random.
        let mut core = core.unpredictable(RandomState::new().hash_one(0));
        if let Some(last) = last {
            core.follow(last.state().core.take_past(now));
        }
        Ok(Connection { state: Mutex::new(State { core, tls, ending: None }), to })
    }

    /// Whether requests can be sent: the connection is open, and any TLS handshake is complete.
    #[getter]
    fn is_ready(&self) -> bool {
        let state = self.state();
        let agreed = state.tls.as_ref().is_none_or(|tls| !tls.is_handshaking());
        agreed && state.core.closed().is_none()
    }

    /// Queues a request; its ticket.
    #[pyo3(signature = (request, unit, timeout, now, attempt=None))]
    fn send(
        &self,
        request: PyRef<'_, Request>,
        unit: i128,
        timeout: f64,
        now: f64,
        attempt: Option<PyRef<'_, Attempt>>,
    ) -> PyResult<u64> {
        let (unit, timeout) = (byte("unit", unit)?, seconds("timeout", timeout)?);
        let attempt = attempt.map_or_else(Default::default, |attempt| attempt.core);
        let mut state = self.state();
        if !state.core.has_room() {
            return Err(PyRuntimeError::new_err("the device takes one request at a time"));
        }
        match state.core.send_again(unit, &request.encoded, timeout, attempt, clock(now)?) {
            Ok(ticket) => Ok(ticket.0),
            Err(why) => Err(raised(self.error(&state.ending, why.failure(), timeout))),
        }
    }

    /// Takes the bytes to send now.
    fn outgoing<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        let State { core, tls, .. } = &mut *self.state();
        let plain = core.outgoing();
        let bytes = match tls {
            None => PyBytes::new(py, plain),
            Some(tls) => {
                tls.send(plain);
                let bytes = PyBytes::new(py, &tls.out);
                tls.out.clear();
                bytes
            }
        };
        let len = plain.len();
        core.sent(len);
        bytes
    }

    /// Processes received bytes and returns the requests that they complete.
    fn receive<'py>(&self, py: Python<'py>, data: &[u8], now: f64) -> PyResult<Completed<'py>> {
        let now = clock(now)?;
        let State { core, tls, ending } = &mut *self.state();
        let mut completed = Completions::new(py);
        let Some(tls) = tls else {
            core.receive(data, now, |done| completed.add(self, ending, done));
            return completed.all;
        };
        let received = tls.receive(data);
        core.receive(&tls.plain, now, |done| completed.add(self, ending, done));
        if received.is_err() || tls.has_ended() {
            *ending = received.err().map(|(failure, maybe_sent)| Ending::Tls(failure, maybe_sent));
            core.close(Closed::ByPeer, |done| completed.add(self, ending, done));
        }
        completed.all
    }

    /// Ends the requests whose timeout has expired.
    fn advance<'py>(&self, py: Python<'py>, now: f64) -> PyResult<Completed<'py>> {
        let State { core, ending, .. } = &mut *self.state();
        let mut completed = Completions::new(py);
        core.advance(clock(now)?, |done| completed.add(self, ending, done));
        completed.all
    }

    /// When to call `advance`.
    #[getter]
    fn deadline(&self) -> Option<f64> {
        self.state().core.deadline().map(|deadline| deadline.as_secs_f64())
    }

    /// Drops a request. A late reply to it is counted.
    fn cancel(&self, ticket: u64) {
        self.state().core.cancel(Ticket(ticket));
    }

    /// Ends the connection and all its requests. `outgoing` may still have bytes to send.
    fn close<'py>(&self, py: Python<'py>) -> PyResult<Completed<'py>> {
        let State { core, tls, ending } = &mut *self.state();
        let mut completed = Completions::new(py);
        core.close(Closed::BySelf, |done| completed.add(self, ending, done));
        if let Some(tls) = tls {
            tls.end();
        }
        completed.all
    }

    /// Reports that the connection is lost. `error` is `None` when the peer closed it normally.
    #[pyo3(signature = (error=None))]
    fn lost<'py>(&self, py: Python<'py>, error: Option<String>) -> PyResult<Completed<'py>> {
        let State { core, tls, ending } = &mut *self.state();
        let mut completed = Completions::new(py);
        if core.closed().is_none() {
            let of_tls = tls.as_ref().and_then(|tls| tls.lost(error.is_some()));
            *ending = match of_tls {
                Some((failure, maybe_sent)) => Some(Ending::Tls(failure, maybe_sent)),
                None => error.map(Ending::Io),
            };
        }
        core.close(Closed::ByPeer, |done| completed.add(self, ending, done));
        completed.all
    }

    /// Why the connection has ended, as an exception; `None` while it is open.
    #[getter]
    fn closed<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyAny>> {
        let state = self.state();
        let failure = state.core.closed()?.failure();
        Some(exception(py, &self.error(&state.ending, failure, Duration::ZERO)))
    }

    /// The number of replies that came after their request had ended.
    #[getter]
    fn late(&self) -> u64 {
        self.state().core.late()
    }

    /// The seconds that the longest of these replies took; 0 if there was none.
    #[getter]
    fn longest_late(&self) -> f64 {
        self.state().core.longest_late().as_secs_f64()
    }
}

impl Connection {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn error(&self, ending: &Option<Ending>, failure: Failure, timeout: Duration) -> ClientError {
        match (failure, ending) {
            (Failure::Closed(Closed::ByPeer), Some(Ending::Tls(failure, maybe_sent))) => {
                let (to, failure) = (self.to.clone(), failure.clone());
                ClientError::Tls { to, failure, maybe_sent: *maybe_sent }
            }
            (Failure::Closed(Closed::ByPeer), Some(Ending::Io(error))) => {
                ClientError::Lost(Lost::Io(io::Error::other(error.clone())))
            }
            (failure, _) => ClientError::new(failure, timeout),
        }
    }
}

/// Collects completed requests, or the first error.
struct Completions<'py> {
    py: Python<'py>,
    all: PyResult<Completed<'py>>,
}

impl<'py> Completions<'py> {
    fn new(py: Python<'py>) -> Completions<'py> {
        Completions { py, all: Ok(Vec::new()) }
    }

    fn add(&mut self, connection: &Connection, ending: &Option<Ending>, done: Done<'_>) {
        let value = match done.outcome {
            Ok(response) => Reply::new(response).into_python(self.py),
            Err(failure) => match done.again {
                Some(core) => Bound::new(self.py, Attempt { core }).map(Bound::into_any),
                None => Ok(exception(self.py, &connection.error(ending, failure, done.timeout))),
            },
        };
        match (&mut self.all, value) {
            (Ok(all), Ok(value)) => all.push((done.ticket.0, value)),
            (all, Err(error)) => *all = Err(error),
            (Err(_), Ok(_)) => {}
        }
    }
}

/// Converts the time of an event loop.
fn clock(now: f64) -> PyResult<Duration> {
    Duration::try_from_secs_f64(now).map_err(|error| PyValueError::new_err(error.to_string()))
}
