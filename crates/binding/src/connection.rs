//! `Connection`: the client side of a TCP connection, with or without TLS, for an event loop. The loop owns
//! the socket; replies go straight to the futures of their requests.

use std::collections::VecDeque;
use std::io;
use std::sync::Mutex;
use std::time::Duration;

use holdfast_engine::client::{ClientError, Direction, Lost, Place, connection};
use holdfast_engine::tls::TlsFailure;
use holdfast_protocol::client::{
    Attempt as CoreAttempt, Closed, Connection as Core, Done, Failure, Ticket, Transport,
};
use holdfast_runtime::lock;
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyByteArray, PyBytes, PySlice};
use pyo3::{PyTraverseError, PyVisit, intern};

use crate::arguments::{byte, seconds};
use crate::channel::Tls;
use crate::client::{Endpoint, Request, exception, of_request, show, to_py_err, value};
use crate::memory::Integer;

/// No call into Python is made while its state is locked, but for those that make objects: the callee could
/// come back.
#[pyclass(frozen, module = "holdfast")]
pub struct Connection {
    state: Mutex<State>,
    /// The URL of the peer.
    to: String,
    /// `create_future` and `time` of the loop.
    create_future: Py<PyAny>,
    time: Py<PyAny>,
    /// Received bytes, until they are processed.
    buffer: Py<PyByteArray>,
    /// What is called with the bytes that are sent and received.
    trace: Option<Py<PyAny>>,
}

/// The bytes that are received at once: seven of the longest replies.
const BUFFER_LEN: usize = 2048;

struct State {
    core: Core,
    tls: Option<Tls>,
    /// Why I/O or TLS ended the connection.
    ending: Option<Ending>,
    /// The futures of the requests that somebody waits for, in the order of their tickets.
    waiting: VecDeque<(u64, Py<PyAny>)>,
    owner: Option<Owner>,
    /// Whether a request waits for a write at the end of this turn of the loop.
    flushes: bool,
    /// When the owner calls `advance`.
    wakes_at: f64,
}

/// What the owner of the socket gave: methods.
struct Owner {
    write: Py<PyAny>,
    flush_soon: Py<PyAny>,
    wake_at: Py<PyAny>,
    changed: Py<PyAny>,
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

#[pymethods]
impl Connection {
    #[new]
    #[pyo3(signature = (endpoint, event_loop, last=None, trace=None))]
    fn new(
        endpoint: PyRef<'_, Endpoint>,
        event_loop: &Bound<'_, PyAny>,
        last: Option<PyRef<'_, Connection>>,
        trace: Option<Py<PyAny>>,
    ) -> PyResult<Connection> {
        let Place::Tcp { tls, .. } = &endpoint.core.place else {
            return Err(PyValueError::new_err("endpoint is not one of TCP or TLS"));
        };
        let to = endpoint.core.to_string();
        let tls = match tls {
            None => None,
            Some(tls) => Some(Tls::new(tls).map_err(|failure| {
                to_py_err(&ClientError::Tls { to: to.clone(), failure, maybe_sent: false })
            })?),
        };
        let time = event_loop.getattr("time")?;
        let now = clock(time.call0()?.extract()?)?;
        let mut core = connection(Transport::Tcp, endpoint.core.tolerance, now);
        if let Some(last) = last {
            core.follow(lock(&last.state).core.take_past(now));
        }
        let state = State {
            core,
            tls,
            ending: None,
            waiting: VecDeque::new(),
            owner: None,
            flushes: false,
            wakes_at: f64::INFINITY,
        };
        let create_future = event_loop.getattr("create_future")?.unbind();
        let (time, state) = (time.unbind(), Mutex::new(state));
        let buffer = PyByteArray::new(event_loop.py(), &[0; BUFFER_LEN]);
        Ok(Connection { state, to, create_future, time, buffer: buffer.unbind(), trace })
    }

    /// Takes the methods of the owner of the socket.
    fn opened(
        &self,
        write: Py<PyAny>,
        flush_soon: Py<PyAny>,
        wake_at: Py<PyAny>,
        changed: Py<PyAny>,
    ) {
        lock(&self.state).owner = Some(Owner { write, flush_soon, wake_at, changed });
    }

    /// Forgets them: the socket is closed.
    fn detach(&self) {
        let owner = lock(&self.state).owner.take();
        drop(owner);
    }

    /// Whether requests can be sent: the connection is open, and any TLS handshake is complete.
    #[getter]
    fn is_ready(&self) -> bool {
        let state = lock(&self.state);
        !state.is_handshaking() && state.core.closed().is_none()
    }

    /// Sends a request, at once if no other is pending; the future of its result.
    #[pyo3(signature = (request, unit, timeout, now, attempt=None))]
    fn send<'py>(
        &self,
        py: Python<'py>,
        request: &Request,
        unit: Integer,
        timeout: f64,
        now: f64,
        attempt: Option<&Attempt>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (unit, within) = (byte("unit", unit.0)?, seconds("timeout", timeout)?);
        let is_first = attempt.is_none();
        let attempt = attempt.map_or_else(Default::default, |attempt| attempt.core);
        let future = self.create_future.bind(py).call0()?;
        let mut state = lock(&self.state);
        if !state.core.has_room() {
            return Err(PyRuntimeError::new_err("the device takes one request at a time"));
        }
        let ticket =
            match state.core.send_again(unit, &request.encoded, within, attempt, clock(now)?) {
                Ok(ticket) => ticket.0,
                Err(why) => {
                    let error = self.error(&state.ending, why.failure(), within);
                    return Err(of_request(py, &error, !is_first));
                }
            };
        let is_alone = state.waiting.is_empty();
        state.waiting.push_back((ticket, future.clone().unbind()));
        let held = if state.core.is_held() { state.core.deadline() } else { None };
        let deadline = held.map_or(now + timeout, |until| until.as_secs_f64());
        let wakes_sooner = deadline < state.wakes_at;
        if wakes_sooner {
            state.wakes_at = deadline;
        }
        let flushes_soon = !is_alone && !std::mem::replace(&mut state.flushes, !is_alone);
        if wakes_sooner || flushes_soon {
            let owner = state
                .owner
                .as_ref()
                .map(|owner| (owner.wake_at.clone_ref(py), owner.flush_soon.clone_ref(py)));
            drop(state);
            if let Some((wake_at, flush_soon)) = owner {
                if wakes_sooner {
                    wake_at.call1(py, (deadline,))?;
                }
                if flushes_soon {
                    flush_soon.call0(py)?;
                }
            }
        } else {
            drop(state);
        }
        if is_alone {
            self.flush(py)?;
        }
        Ok(future)
    }

    /// Writes what is to be sent now.
    fn flush(&self, py: Python<'_>) -> PyResult<()> {
        let mut state = lock(&self.state);
        state.flushes = false;
        let write = state.owner.as_ref().map(|owner| owner.write.clone_ref(py));
        let traced = self.trace.as_ref().map(|_| state.core.outgoing().to_vec());
        let Some((write, outgoing)) = write.zip(state.outgoing(py)) else { return Ok(()) };
        drop(state);
        // What it raises ends nothing: the bytes are sent all the same.
        let raised = self.show(Direction::Sent, &traced.unwrap_or_default());
        write.call1(py, (outgoing,))?;
        raised
    }

    /// Where the loop puts received bytes.
    #[pyo3(signature = (_size, /))]
    fn get_buffer(&self, py: Python<'_>, _size: i64) -> Py<PyByteArray> {
        self.buffer.clone_ref(py)
    }

    /// Processes so many bytes of the buffer.
    #[pyo3(signature = (len, /))]
    fn buffer_updated(&self, py: Python<'_>, len: i16) -> PyResult<()> {
        let filled = self.buffer.bind(py).get_item(PySlice::new(py, 0, len.into(), 1))?;
        self.data_received(py, &filled.cast_into::<PyByteArray>()?.to_vec())
    }

    /// Processes received bytes, and completes the requests that they answer.
    #[pyo3(signature = (data, /))]
    fn data_received(&self, py: Python<'_>, data: &[u8]) -> PyResult<()> {
        let now = clock(self.time.bind(py).call0()?.extract()?)?;
        let mut state = lock(&self.state);
        let was_handshaking = state.is_handshaking();
        let completed = self.complete(py, &mut state, |core, tls, ending, add| {
            let Some(tls) = tls else {
                return core.receive(data, now, |done| add(ending, done));
            };
            let received = tls.receive(data);
            core.receive(&tls.plain, now, |done| add(ending, done));
            if received.is_err() || tls.has_ended() {
                *ending =
                    received.err().map(|(failure, maybe_sent)| Ending::Tls(failure, maybe_sent));
                core.close(Closed::ByPeer, |done| add(ending, done));
            }
        });
        let has_changed = was_handshaking || state.core.closed().is_some();
        let owner = state.owner.as_ref().filter(|_| has_changed);
        let changed = owner.map(|owner| owner.changed.clone_ref(py));
        let plain = self.trace.as_ref().and(state.tls.as_ref()).map(|tls| tls.plain.clone());
        drop(state);
        let raised = self.show(Direction::Received, plain.as_deref().unwrap_or(data));
        settle(py, completed)?;
        if let Some(changed) = changed {
            changed.call0(py)?;
        }
        raised
    }

    /// Ends the requests whose timeout has expired. When to call it again; `None` for no request.
    fn advance(&self, py: Python<'_>) -> PyResult<Option<f64>> {
        let now = clock(self.time.bind(py).call0()?.extract()?)?;
        let mut state = lock(&self.state);
        let completed = self.complete(py, &mut state, |core, _, ending, add| {
            core.advance(now, |done| add(ending, done));
        });
        drop(state);
        settle(py, completed)?;
        // Requests that the caller of an ended one has sent meanwhile are among them.
        let mut state = lock(&self.state);
        let deadline = state.core.deadline().map(|deadline| deadline.as_secs_f64());
        state.wakes_at = deadline.unwrap_or(f64::INFINITY);
        Ok(deadline)
    }

    /// Drops a request whose caller no longer waits. A late reply to it is counted.
    fn cancel(&self, future: &Bound<'_, PyAny>, now: f64) -> PyResult<()> {
        let now = clock(now)?;
        let mut state = lock(&self.state);
        if let Some(at) = state.waiting.iter().position(|(_, other)| other.is(future))
            && let Some((ticket, _)) = state.waiting.remove(at)
        {
            state.core.cancel(Ticket(ticket), now);
        }
        Ok(())
    }

    /// Ends the connection and all its requests. `flush` may still have bytes to write.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        let mut state = lock(&self.state);
        let completed = self.complete(py, &mut state, |core, tls, ending, add| {
            core.close(Closed::BySelf, |done| add(ending, done));
            if let Some(tls) = tls {
                tls.end();
            }
        });
        drop(state);
        settle(py, completed)
    }

    /// Reports that the connection is lost. `error` is `None` when the peer closed it normally.
    #[pyo3(signature = (error=None))]
    fn lost(&self, py: Python<'_>, error: Option<String>) -> PyResult<()> {
        let mut state = lock(&self.state);
        let completed = self.complete(py, &mut state, |core, tls, ending, add| {
            if core.closed().is_none() {
                let of_tls = tls.as_ref().and_then(|tls| tls.lost(error.is_some()));
                *ending = match of_tls {
                    Some((failure, maybe_sent)) => Some(Ending::Tls(failure, maybe_sent)),
                    None => error.map(Ending::Io),
                };
            }
            core.close(Closed::ByPeer, |done| add(ending, done));
        });
        drop(state);
        settle(py, completed)
    }

    /// Why the connection has ended, as an exception; `None` while it is open.
    #[getter]
    fn closed<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyAny>> {
        let state = lock(&self.state);
        let failure = state.core.closed()?.failure();
        Some(exception(py, &self.error(&state.ending, failure, Duration::ZERO)))
    }

    /// The number of replies that came after their request had ended.
    #[getter]
    fn late(&self) -> u64 {
        lock(&self.state).core.late()
    }

    /// The seconds that the longest of these replies took; 0 if there was none.
    #[getter]
    fn longest_late(&self) -> f64 {
        lock(&self.state).core.longest_late().as_secs_f64()
    }

    fn __traverse__(&self, visit: PyVisit<'_>) -> Result<(), PyTraverseError> {
        visit.call(&self.create_future)?;
        visit.call(&self.time)?;
        if let Some(trace) = &self.trace {
            visit.call(trace)?;
        }
        // What a locked state has is in use.
        let Ok(state) = self.state.try_lock() else { return Ok(()) };
        for (_, future) in &state.waiting {
            visit.call(future)?;
        }
        if let Some(Owner { write, flush_soon, wake_at, changed }) = &state.owner {
            for method in [write, flush_soon, wake_at, changed] {
                visit.call(method)?;
            }
        }
        Ok(())
    }

    fn __clear__(&self) {
        let mut state = lock(&self.state);
        let left = (std::mem::take(&mut state.waiting), state.owner.take());
        drop(state);
        drop(left);
    }
}

impl State {
    fn is_handshaking(&self) -> bool {
        self.tls.as_ref().is_some_and(Tls::is_handshaking)
    }

    /// Takes the bytes to send now, if there are any.
    fn outgoing<'py>(&mut self, py: Python<'py>) -> Option<Bound<'py, PyBytes>> {
        let plain = self.core.outgoing();
        let bytes = match &mut self.tls {
            None if plain.is_empty() => return None,
            None => PyBytes::new(py, plain),
            Some(tls) => {
                tls.send(plain);
                let bytes = PyBytes::new(py, &tls.out);
                tls.out.clear();
                bytes
            }
        };
        let len = plain.len();
        self.core.sent(len);
        Some(bytes).filter(|bytes| !bytes.as_bytes().is_empty())
    }
}

impl Connection {
    /// Shows bytes to the trace. An error is what it raised that is no `Exception`.
    fn show(&self, direction: Direction, bytes: &[u8]) -> PyResult<()> {
        let trace = self.trace.as_ref().filter(|_| !bytes.is_empty());
        trace.and_then(|trace| show(trace, direction, bytes)).map_or(Ok(()), Err)
    }

    /// Collects what `work` completes.
    fn complete(
        &self,
        py: Python<'_>,
        State { core, tls, ending, waiting, .. }: &mut State,
        work: impl FnOnce(
            &mut Core,
            &mut Option<Tls>,
            &mut Option<Ending>,
            &mut dyn FnMut(&Option<Ending>, Done<'_>),
        ),
    ) -> Vec<Completed> {
        let mut completed = Vec::new();
        work(core, tls, ending, &mut |ending, done| {
            let Ok(at) = waiting.binary_search_by_key(&done.ticket.0, |(ticket, _)| *ticket) else {
                return;
            };
            let Some((_, future)) = waiting.remove(at) else { return };
            let outcome = match done.outcome {
                Ok(response) => value(py, response).map(Bound::unbind),
                Err(failure) => match done.again {
                    Some(core) => Py::new(py, Attempt { core }).map(Py::into_any),
                    None => {
                        let error = self.error(ending, failure, done.timeout);
                        Err(of_request(py, &error, done.maybe_sent))
                    }
                },
            };
            completed.push((future, outcome));
        });
        completed
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

/// A future, and the result or the exception of its request.
type Completed = (Py<PyAny>, PyResult<Py<PyAny>>);

/// Delivers results. Futures of calls that were cancelled are left alone.
fn settle(py: Python<'_>, completed: Vec<Completed>) -> PyResult<()> {
    for (future, outcome) in completed {
        let future = future.bind(py);
        let delivered = match outcome {
            Ok(value) => future.call_method1(intern!(py, "set_result"), (value,)),
            Err(error) => future.call_method1(intern!(py, "set_exception"), (error,)),
        };
        if let Err(error) = delivered
            && !future.call_method0(intern!(py, "cancelled"))?.is_truthy()?
        {
            return Err(error);
        }
    }
    Ok(())
}

/// Converts the time of an event loop.
fn clock(now: f64) -> PyResult<Duration> {
    Duration::try_from_secs_f64(now).map_err(|error| PyValueError::new_err(error.to_string()))
}
