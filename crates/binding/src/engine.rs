//! `Rule`, `Listener` and `Engine`: settings in, addresses, counters and events out.

use std::net::{IpAddr, SocketAddr};
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use holdfast_engine::event::Verbosity;
use holdfast_engine::policy::{Functions, Rights, Rule as CoreRule};
use holdfast_engine::{Engine as Core, ListenerSettings, Settings, StartError, WhenFull};
use ipnet::IpNet;
use pyo3::exceptions::{PyOSError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyMapping};

use crate::memory::Memory;

#[pyclass(frozen, module = "holdfast")]
pub struct Rule {
    core: CoreRule,
}

#[pymethods]
impl Rule {
    #[new]
    #[pyo3(signature = (units, *, sources, access, functions=None, deny=None))]
    fn new(
        units: &Bound<'_, PyMapping>,
        sources: Vec<String>,
        access: &str,
        functions: Option<Vec<i128>>,
        deny: Option<Vec<i128>>,
    ) -> PyResult<Rule> {
        let sources = sources.iter().map(|text| network(text)).collect::<PyResult<_>>()?;
        let rights = match access {
            "read-only" => Rights::ReadOnly,
            "read-write" => Rights::ReadWrite,
            _ => return Err(unknown("access", access, "read-only, read-write")),
        };
        let codes = |codes: Option<Vec<i128>>| {
            let codes =
                codes.map(|codes| codes.into_iter().map(|code| byte("function code", code)));
            codes.map(Iterator::collect::<PyResult<Vec<u8>>>).transpose()
        };
        let functions = match (codes(functions)?, codes(deny)?) {
            (None, None) => Functions::All,
            (Some(codes), None) => Functions::Only(codes),
            (None, Some(codes)) => Functions::Except(codes),
            (Some(_), Some(_)) => {
                return Err(PyValueError::new_err("functions and deny exclude each other"));
            }
        };
        let mut mapped: Vec<(u8, Arc<_>)> = Vec::new();
        for item in units.items()?.iter() {
            let (unit, memory): (i128, PyRef<'_, Memory>) = item.extract()?;
            mapped.push((byte("unit id", unit)?, Arc::clone(&memory.core)));
        }
        Ok(Rule { core: CoreRule { sources, units: mapped, rights, functions } })
    }
}

#[pyclass(frozen, module = "holdfast")]
pub struct Listener {
    core: ListenerSettings,
}

#[pymethods]
impl Listener {
    #[new]
    #[pyo3(signature = (name, bind, rules, *, max_connections=256, max_connections_per_source=None, when_full="refuse", idle_timeout=300.0, request_timeout=10.0))]
    #[allow(clippy::too_many_arguments, reason = "they are keywords in Python")]
    fn new(
        name: String,
        bind: &str,
        rules: Vec<PyRef<'_, Rule>>,
        max_connections: i128,
        max_connections_per_source: Option<i128>,
        when_full: &str,
        idle_timeout: f64,
        request_timeout: f64,
    ) -> PyResult<Listener> {
        let bind = bind
            .parse::<SocketAddr>()
            .map_err(|_| unknown("bind", bind, "address:port as in 127.0.0.1:502 or [::1]:502"))?;
        let when_full = match when_full {
            "refuse" => WhenFull::Refuse,
            "evict" => WhenFull::Evict,
            _ => return Err(unknown("when_full", when_full, "refuse, evict")),
        };
        let max_connections = within("max_connections", max_connections, 1..=65_535)?;
        let max_connections_per_source = max_connections_per_source
            .map(|most| within("max_connections_per_source", most, 1..=65_535))
            .transpose()?;
        let idle_timeout = seconds("idle_timeout", idle_timeout)?;
        let request_timeout = seconds("request_timeout", request_timeout)?;
        if request_timeout.is_zero() {
            return Err(PyValueError::new_err("request_timeout is 0, more is allowed"));
        }
        Ok(Listener {
            core: ListenerSettings {
                name,
                bind,
                rules: rules.iter().map(|rule| rule.core.clone()).collect(),
                max_connections,
                max_connections_per_source,
                when_full,
                idle_timeout: (!idle_timeout.is_zero()).then_some(idle_timeout),
                request_timeout,
            },
        })
    }
}

#[pyclass(frozen, module = "holdfast")]
pub struct Engine {
    core: Core,
}

#[pymethods]
impl Engine {
    #[new]
    #[pyo3(signature = (listeners, *, identity, unit_names=None, workers=1, events="nothing"))]
    fn new(
        py: Python<'_>,
        listeners: Vec<PyRef<'_, Listener>>,
        identity: Vec<(u8, String)>,
        unit_names: Option<Vec<(u8, String)>>,
        workers: i128,
        events: &str,
    ) -> PyResult<Engine> {
        let workers = within("workers", workers, 1..=64)?;
        let events = match events {
            "nothing" => Verbosity::Nothing,
            "refusals" => Verbosity::Refusals,
            "all" => Verbosity::All,
            _ => return Err(unknown("events", events, "nothing, refusals, all")),
        };
        let bytes = |texts: Vec<(u8, String)>| {
            texts.into_iter().map(|(id, text)| (id, text.into_bytes())).collect()
        };
        let settings = Settings {
            listeners: listeners.iter().map(|listener| listener.core.clone()).collect(),
            identity: bytes(identity),
            unit_names: bytes(unit_names.unwrap_or_default()),
            workers,
            events,
        };
        drop(listeners);
        let core = py.detach(|| Core::start(settings)).map_err(start_error)?;
        Ok(Engine { core })
    }

    #[getter]
    fn addresses(&self) -> Vec<(String, u16)> {
        let addresses = self.core.addresses().into_iter();
        addresses.map(|address| (address.ip().to_string(), address.port())).collect()
    }

    fn counters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for (name, counters, open) in self.core.counters() {
            let connections = PyDict::new(py);
            let counted = &counters.connections;
            for (key, counter) in [
                ("accepted", &counted.accepted),
                ("refused_source", &counted.refused_source),
                ("refused_full", &counted.refused_full),
                ("evicted", &counted.evicted),
                ("idle", &counted.idle),
                ("request_timeout", &counted.request_timeout),
                ("slow_reader", &counted.slow_reader),
                ("accept_errors", &counted.accept_errors),
            ] {
                connections.set_item(key, counter.get())?;
            }
            connections.set_item("open", open)?;
            let frames = PyDict::new(py);
            frames.set_item("foreign", counters.frames.foreign.get())?;
            frames.set_item("broken", counters.frames.broken.get())?;
            let listener = PyDict::new(py);
            listener.set_item("requests", by_code(py, counters.requests())?)?;
            listener.set_item("exceptions", by_code(py, counters.exceptions())?)?;
            listener.set_item("unanswered", counters.unanswered.get())?;
            listener.set_item("connections", connections)?;
            listener.set_item("frames", frames)?;
            all.set_item(name, listener)?;
        }
        Ok(all)
    }

    fn next_event(
        &self,
        py: Python<'_>,
        timeout: f64,
    ) -> PyResult<Option<(String, &str, Option<String>)>> {
        let timeout = seconds("timeout", timeout)?;
        let event = py.detach(|| self.core.next_event(timeout));
        Ok(event.map(|event| {
            let peer = event
                .peer
                .map(|peer| SocketAddr::new(peer.ip().to_canonical(), peer.port()).to_string());
            (event.listener.to_string(), event.kind.name(), peer)
        }))
    }

    #[getter]
    fn lost_events(&self) -> u64 {
        self.core.lost_events()
    }

    fn stop(&self, py: Python<'_>) {
        py.detach(|| self.core.stop());
    }
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

/// An integer of a range that a `usize` holds.
fn within(what: &str, found: i128, allowed: RangeInclusive<usize>) -> PyResult<usize> {
    usize::try_from(found).ok().filter(|number| allowed.contains(number)).ok_or_else(|| {
        let (least, most) = (allowed.start(), allowed.end());
        PyValueError::new_err(format!("{what} is {found}, allowed are {least} to {most}"))
    })
}

fn byte(what: &str, found: i128) -> PyResult<u8> {
    Ok(within(what, found, 0..=255)? as u8)
}

fn unknown(what: &str, found: &str, allowed: &str) -> PyErr {
    PyValueError::new_err(format!("{what} is {found:?}, allowed are {allowed}"))
}

/// A network, or one address.
fn network(text: &str) -> PyResult<IpNet> {
    let network = text.parse::<IpNet>().ok();
    network.or_else(|| text.parse::<IpAddr>().ok().map(IpNet::from)).ok_or_else(|| {
        unknown("source", text, "addresses and networks as in 10.0.0.0/8 or fd00::/64")
    })
}

fn seconds(what: &str, seconds: f64) -> PyResult<Duration> {
    Duration::try_from_secs_f64(seconds)
        .ok()
        .filter(|duration| duration.as_secs() <= 366 * 24 * 3600)
        .ok_or_else(|| unknown(what, &seconds.to_string(), "0 to 31622400 seconds"))
}

/// An `OSError` with the system's number where a socket failed, so that Python picks its subclass.
fn start_error(error: StartError) -> PyErr {
    match &error {
        StartError::Bind { error: cause, .. } | StartError::Worker(cause) => {
            PyOSError::new_err((cause.raw_os_error(), error.to_string()))
        }
        StartError::Identity(_) => PyValueError::new_err(error.to_string()),
    }
}
