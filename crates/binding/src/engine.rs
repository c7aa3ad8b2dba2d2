//! `Engine`: runs listeners; reports addresses, counters, events and writes.

use std::time::UNIX_EPOCH;

use holdfast_engine::server::reports::audit::Unrecordable;
use holdfast_engine::server::reports::counters::PacketCounters;
use holdfast_engine::server::reports::event::{Event, Kind, Verbosity};
use holdfast_engine::server::{
    Engine as Core, ListenerCounters, Listening, OpenConnection, ProtocolCounters, Settings,
    StartError,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyDict};

use crate::arguments::{byte, os_error, seconds, within, word};
use crate::audit_fields;
use crate::heartbeat;
use crate::listener::Listener;
use crate::memory::Integer;
use crate::peer;

#[pyclass(frozen, weakref, module = "holdfast")]
pub struct Engine {
    core: Core,
}

#[pymethods]
impl Engine {
    #[new]
    #[pyo3(signature = (listeners, *, identity, unit_names=None, workers=1, events="nothing", audit=None))]
    fn new(
        py: Python<'_>,
        listeners: Vec<PyRef<'_, Listener>>,
        identity: Vec<(Integer, String)>,
        unit_names: Option<Vec<(Integer, String)>>,
        workers: i128,
        events: &str,
        audit: Option<&str>,
    ) -> PyResult<Engine> {
        let workers = within("workers", workers, 1..=64)?;
        let unrecordable = [("open", Unrecordable::Write), ("closed", Unrecordable::Refuse)];
        let audit = audit.map(|given| word("audit", given, &unrecordable)).transpose()?;
        let listening = listening(listeners, identity, unit_names)?;
        let settings = Settings { listening, workers, events: verbosity(events)?, audit };
        let core = py.detach(|| Core::start(settings)).map_err(start_error)?;
        Ok(Engine { core })
    }

    #[pyo3(signature = (listeners, *, identity, unit_names=None, events="nothing"))]
    fn reload(
        &self,
        py: Python<'_>,
        listeners: Vec<PyRef<'_, Listener>>,
        identity: Vec<(Integer, String)>,
        unit_names: Option<Vec<(Integer, String)>>,
        events: &str,
    ) -> PyResult<()> {
        let (verbosity, listening) =
            (verbosity(events)?, listening(listeners, identity, unit_names)?);
        py.detach(|| self.core.reload(listening)).map_err(start_error)?;
        self.core.set_verbosity(verbosity);
        Ok(())
    }

    fn review(&self, py: Python<'_>) {
        py.detach(|| self.core.review());
    }

    fn sessions<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyDict>>> {
        let listeners = self.core.open_connections();
        let all = listeners.iter().flat_map(|(listener, sessions)| {
            sessions.iter().map(move |session| (listener, session))
        });
        all.map(|(listener, session)| session_to_python(py, listener, session)).collect()
    }

    fn end_session(&self, py: Python<'_>, listener: &str, id: u64) -> bool {
        py.detach(|| self.core.end_connection(listener, id))
    }

    fn heartbeats(&self) -> Vec<(String, f64, Option<u32>)> {
        self.core.heartbeats().iter().map(|beats| heartbeat::to_python(beats)).collect()
    }

    #[getter]
    fn addresses(&self) -> Vec<Option<(String, u16)>> {
        let addresses = self.core.addresses().into_iter();
        addresses.map(|at| at.map(|at| (at.ip().to_string(), at.port()))).collect()
    }

    #[getter]
    fn sockets(&self) -> Vec<(&'static str, String, u16)> {
        let sockets = self.core.sockets().into_iter();
        sockets.map(|(kind, at)| (kind.name(), at.ip().to_string(), at.port())).collect()
    }

    fn counters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for listener in self.core.counters() {
            all.set_item(listener.name(), counters_to_python(py, &listener)?)?;
        }
        Ok(all)
    }

    fn next_event<'py>(
        &self,
        py: Python<'py>,
        timeout: f64,
    ) -> PyResult<Option<(String, &'static str, Bound<'py, PyDict>)>> {
        let timeout = seconds("timeout", timeout)?;
        let Some(event) = py.detach(|| self.core.next_event(timeout)) else { return Ok(None) };
        let fields = event_fields(py, &event)?;
        Ok(Some((event.listener.to_string(), event.kind.name(), fields)))
    }

    fn next_writes<'py>(
        &self,
        py: Python<'py>,
        timeout: f64,
        most: usize,
    ) -> PyResult<Vec<Bound<'py, PyDict>>> {
        let timeout = seconds("timeout", timeout)?;
        let records = py.detach(|| self.core.next_writes(timeout, most));
        records.iter().map(|record| audit_fields::to_python(py, record)).collect()
    }

    fn set_audit_failing(&self, failing: bool) {
        self.core.set_audit_failing(failing);
    }

    #[getter]
    fn lost_writes(&self) -> u64 {
        self.core.lost_writes()
    }

    #[getter]
    fn other_refused_writes(&self) -> u64 {
        self.core.other_refused_writes()
    }

    #[getter]
    fn lost_events(&self) -> u64 {
        self.core.lost_events()
    }

    fn stop(&self, py: Python<'_>) {
        py.detach(|| self.core.stop());
    }
}

fn listening(
    listeners: Vec<PyRef<'_, Listener>>,
    identity: Vec<(Integer, String)>,
    unit_names: Option<Vec<(Integer, String)>>,
) -> PyResult<Listening> {
    let bytes = |what, texts: Vec<(Integer, String)>| {
        let texts = texts.into_iter();
        texts.map(|(id, text)| Ok((byte(what, id.0)?, text.into_bytes()))).collect::<PyResult<_>>()
    };
    Ok(Listening {
        listeners: listeners.iter().map(|listener| listener.core.clone()).collect(),
        identity: bytes("object id", identity)?,
        unit_names: bytes("unit id", unit_names.unwrap_or_default())?,
    })
}

fn verbosity(events: &str) -> PyResult<Verbosity> {
    let verbosities = [
        ("nothing", Verbosity::Nothing),
        ("refusals", Verbosity::Refusals),
        ("all", Verbosity::All),
    ];
    word("events", events, &verbosities)
}

fn session_to_python<'py>(
    py: Python<'py>,
    listener: &str,
    session: &OpenConnection,
) -> PyResult<Bound<'py, PyDict>> {
    let all = PyDict::new(py);
    all.set_item("listener", listener)?;
    all.set_item("id", session.id)?;
    peer::add_to(&all, &session.peer)?;
    let opened = session.opened.duration_since(UNIX_EPOCH).unwrap_or_default();
    all.set_item("opened", opened.as_secs_f64())?;
    all.set_item("idle", session.idle.as_secs_f64())?;
    Ok(all)
}

fn packet_counters_to_python<'py>(
    py: Python<'py>,
    counters: &PacketCounters,
) -> PyResult<Bound<'py, PyDict>> {
    let packets = counters.by_name().into_py_dict(py)?;
    let refused = counters.refused().map(|(refusal, count)| (refusal.name(), count));
    packets.set_item("refused", refused.into_py_dict(py)?)?;
    Ok(packets)
}

fn counters_to_python<'py>(
    py: Python<'py>,
    listener: &ListenerCounters,
) -> PyResult<Bound<'py, PyDict>> {
    let all = PyDict::new(py);
    match &listener.protocol {
        ProtocolCounters::Modbus(unit_server, packets) => {
            let counters = &unit_server.counters;
            all.set_item("requests", counters.requests().into_py_dict(py)?)?;
            all.set_item("exceptions", counters.exceptions().into_py_dict(py)?)?;
            all.set_item("unanswered", counters.unanswered.get())?;
            all.set_item("frames", counters.frames.by_name().into_py_dict(py)?)?;
            if let Some(packets) = packets {
                all.set_item("packets", packet_counters_to_python(py, packets)?)?;
            }
        }
        ProtocolCounters::Packets(packets) => {
            all.set_item("packets", packet_counters_to_python(py, packets)?)?;
        }
    }
    let counters = listener.connections();
    let connections = counters.by_name().into_py_dict(py)?;
    connections.set_item("tls_failed", counters.tls_failed.total())?;
    connections.set_item("open", listener.open_connections)?;
    all.set_item("connections", connections)?;
    all.set_item("tls_failures", counters.tls_failed.by_reason())?;
    Ok(all)
}

/// The fields of an event, for a log.
pub(crate) fn event_fields<'py>(py: Python<'py>, event: &Event) -> PyResult<Bound<'py, PyDict>> {
    let fields = PyDict::new(py);
    if let Some(peer) = &event.peer {
        peer::add_to(&fields, peer)?;
    }
    if let Some(subject) = &event.subject {
        fields.set_item("subject", &**subject)?;
    }
    if event.count > 1 {
        fields.set_item("count", event.count)?;
    }
    if let Some(error) = event.kind.error() {
        fields.set_item("error", error)?;
    }
    if let Some(reason) = event.kind.reason() {
        fields.set_item("reason", reason)?;
    }
    if let Some(bytes) = event.kind.bytes() {
        fields.set_item("bytes", bytes)?;
    }
    if let Kind::UnitSilenced(unit_id) | Kind::UnitBack(unit_id) = event.kind {
        fields.set_item("unit", unit_id)?;
    }
    if let Kind::RefusedRequest(refused) = event.kind {
        fields.set_item("unit", refused.unit_id)?;
        fields.set_item("function", refused.function_code)?;
    }
    Ok(fields)
}

/// Maps a failed socket to an `OSError` with its `errno`, so that Python selects the subclass.
fn start_error(error: StartError) -> PyErr {
    let text = error.to_string();
    match error {
        StartError::Bind { error, .. }
        | StartError::Open { error, .. }
        | StartError::Worker(error) => os_error(&error, text),
        StartError::Identity(_) => PyValueError::new_err(text),
    }
}
