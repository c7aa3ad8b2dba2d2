//! `Engine`: runs listeners; reports addresses, counters, events and writes.

use holdfast_engine::server::audit::Unrecordable;
use holdfast_engine::server::counters::PacketCounters;
use holdfast_engine::server::event::Verbosity;
use holdfast_engine::server::{
    Engine as Core, ListenerCounters, ProtocolCounters, Settings, StartError,
};
use pyo3::exceptions::{PyOSError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arguments::{seconds, within, word};
use crate::audit;
use crate::listener::Listener;

#[pyclass(frozen, module = "holdfast")]
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
        identity: Vec<(u8, String)>,
        unit_names: Option<Vec<(u8, String)>>,
        workers: i128,
        events: &str,
        audit: Option<&str>,
    ) -> PyResult<Engine> {
        let workers = within("workers", workers, 1..=64)?;
        let verbosities = [
            ("nothing", Verbosity::Nothing),
            ("refusals", Verbosity::Refusals),
            ("all", Verbosity::All),
        ];
        let events = word("events", events, &verbosities)?;
        let unrecordable = [("open", Unrecordable::Write), ("closed", Unrecordable::Refuse)];
        let audit = audit.map(|given| word("audit", given, &unrecordable)).transpose()?;
        let bytes = |texts: Vec<(u8, String)>| {
            texts.into_iter().map(|(id, text)| (id, text.into_bytes())).collect()
        };
        let settings = Settings {
            listeners: listeners.iter().map(|listener| listener.core.clone()).collect(),
            identity: bytes(identity),
            unit_names: bytes(unit_names.unwrap_or_default()),
            workers,
            events,
            audit,
        };
        drop(listeners);
        let core = py.detach(|| Core::start(settings)).map_err(start_error)?;
        Ok(Engine { core })
    }

    #[getter]
    fn addresses(&self) -> Vec<Option<(String, u16)>> {
        let addresses = self.core.addresses().into_iter();
        addresses.map(|at| at.map(|at| (at.ip().to_string(), at.port()))).collect()
    }

    fn counters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for listener in self.core.counters() {
            all.set_item(listener.name, counted(py, &listener)?)?;
        }
        Ok(all)
    }

    fn next_event(&self, py: Python<'_>, timeout: f64) -> PyResult<Option<Event>> {
        let timeout = seconds("timeout", timeout)?;
        let event = py.detach(|| self.core.next_event(timeout));
        Ok(event.map(|event| {
            let reason = event.role.or_else(|| event.kind.reason().map(Box::from));
            let (kind, peer) = (event.kind.name(), event.peer.map(crate::peer::text));
            let (reason, bytes) = (reason.map(String::from), event.kind.bytes());
            (event.listener.to_string(), kind, peer, reason, bytes)
        }))
    }

    fn next_writes<'py>(
        &self,
        py: Python<'py>,
        timeout: f64,
        most: usize,
    ) -> PyResult<Vec<Bound<'py, PyDict>>> {
        let timeout = seconds("timeout", timeout)?;
        let records = py.detach(|| self.core.next_writes(timeout, most));
        records.iter().map(|record| audit::to_python(py, record)).collect()
    }

    fn set_audit_failing(&self, failing: bool) {
        self.core.set_audit_failing(failing);
    }

    #[getter]
    fn lost_writes(&self) -> u64 {
        self.core.lost_writes()
    }

    #[getter]
    fn lost_events(&self) -> u64 {
        self.core.lost_events()
    }

    fn stop(&self, py: Python<'_>) {
        py.detach(|| self.core.stop());
    }
}

/// Listener, kind, peer, reason and number of bytes. For a peer that was refused for its role, the
/// reason is the role.
type Event = (String, &'static str, Option<String>, Option<String>, Option<u64>);

fn counted_packets<'py>(
    py: Python<'py>,
    counters: &PacketCounters,
) -> PyResult<Bound<'py, PyDict>> {
    let refused = PyDict::new(py);
    for (refusal, count) in counters.refused() {
        refused.set_item(refusal.name(), count)?;
    }
    let packets = PyDict::new(py);
    packets.set_item("accepted", counters.accepted.get())?;
    packets.set_item("values", counters.values.get())?;
    packets.set_item("dropped_bytes", counters.dropped_bytes.get())?;
    packets.set_item("refused", refused)?;
    Ok(packets)
}

fn counted<'py>(py: Python<'py>, listener: &ListenerCounters<'_>) -> PyResult<Bound<'py, PyDict>> {
    let all = PyDict::new(py);
    match &listener.protocol {
        ProtocolCounters::Modbus(counters, packets) => {
            let frames = PyDict::new(py);
            frames.set_item("foreign", counters.frames.foreign.get())?;
            frames.set_item("broken", counters.frames.broken.get())?;
            frames.set_item("damaged", counters.frames.damaged.get())?;
            frames.set_item("other_unit", counters.frames.other_unit.get())?;
            all.set_item("requests", by_code(py, counters.requests())?)?;
            all.set_item("exceptions", by_code(py, counters.exceptions())?)?;
            all.set_item("unanswered", counters.unanswered.get())?;
            all.set_item("frames", frames)?;
            if let Some(packets) = packets {
                all.set_item("packets", counted_packets(py, packets)?)?;
            }
        }
        ProtocolCounters::Packets(packets) => {
            all.set_item("packets", counted_packets(py, packets)?)?;
        }
    }
    let counters = listener.connections;
    let connections = PyDict::new(py);
    for (key, counter) in [
        ("accepted", &counters.accepted),
        ("refused_source", &counters.refused_source),
        ("refused_role", &counters.refused_role),
        ("tls_failed", &counters.tls_failed),
        ("refused_full", &counters.refused_full),
        ("refused_listen_only", &counters.refused_listen_only),
        ("evicted", &counters.evicted),
        ("idle", &counters.idle),
        ("request_timeout", &counters.request_timeout),
        ("slow_reader", &counters.slow_reader),
        ("accept_errors", &counters.accept_errors),
    ] {
        connections.set_item(key, counter.get())?;
    }
    connections.set_item("open", listener.open_connections)?;
    all.set_item("connections", connections)?;
    Ok(all)
}

fn by_code<'py>(
    py: Python<'py>,
    counts: impl Iterator<Item = (u8, u64)>,
) -> PyResult<Bound<'py, PyDict>> {
    let all = PyDict::new(py);
    for (code, count) in counts {
        all.set_item(code, count)?;
    }
    Ok(all)
}

/// Maps a failed socket to an `OSError` with its `errno`, so that Python selects the subclass.
fn start_error(error: StartError) -> PyErr {
    match &error {
        StartError::Bind { error: cause, .. }
        | StartError::Open { error: cause, .. }
        | StartError::Worker(cause) => match cause.raw_os_error() {
            Some(number) => PyOSError::new_err((number, error.to_string())),
            None => PyOSError::new_err(error.to_string()),
        },
        StartError::Identity(_) => PyValueError::new_err(error.to_string()),
    }
}
