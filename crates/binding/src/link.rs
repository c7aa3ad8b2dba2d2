//! `Link`, `Route`, `Withdrawal`, `Passage` and `Caller`: devices that listeners and event loops ask.

use std::sync::{Arc, Mutex};

use holdfast_engine::Wakes;
use holdfast_engine::client::{Peers, StrayCounters};
use holdfast_engine::link::{
    Caller as CoreCaller, InFlight, LinkSettings, Route as CoreRoute, SharedLink,
    Withdrawal as CoreWithdrawal,
};
use holdfast_engine::poller::{Passage as CorePassage, PassedRange};
use holdfast_memory::Area;
use holdfast_protocol::pdu::{self, Bits, Registers, Request as CoreRequest, limit};
use holdfast_runtime::{Retry, lock};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyDict};

use crate::arguments::{byte, ip_addresses, seconds, within};
use crate::client::{Endpoint, Request, exception, response, value};
use crate::memory::named;

/// The number of requests in flight; `None` is `auto`.
pub(crate) fn in_flight(number: Option<i128>) -> PyResult<InFlight> {
    Ok(match number {
        Some(number) => {
            InFlight::Fixed(within("in_flight", number, 1..=InFlight::MAX.into())? as u16)
        }
        None => InFlight::Auto,
    })
}

/// The first and the longest pause before another try, in seconds; `None` for the defaults.
pub(crate) fn retry(pauses: Option<(f64, f64)>) -> PyResult<Retry> {
    let Some((first, most)) = pauses else { return Ok(Retry::default()) };
    Ok(Retry { first: seconds("first", first)?, most: seconds("most", most)?, jitter: true })
}

#[allow(clippy::too_many_arguments, reason = "they are keywords in Python")]
pub(crate) fn settings(
    endpoint: &Endpoint,
    (number, pauses): (Option<i128>, Option<(f64, f64)>),
    queue: Option<i128>,
    coalesce: bool,
    cache: f64,
    preferred: &[String],
) -> PyResult<LinkSettings> {
    Ok(LinkSettings {
        endpoint: endpoint.core.clone(),
        in_flight: in_flight(number)?,
        retry: retry(pauses)?,
        queue: queue.map_or(Ok(LinkSettings::QUEUE), |queue| {
            within("queue", queue, 1..=LinkSettings::MAX_QUEUE)
        })?,
        coalesce,
        cache: seconds("cache", cache)?,
        preferred: ip_addresses("preferred", preferred)?,
    })
}

#[pyclass(frozen, module = "holdfast")]
pub struct Link {
    pub(crate) core: Arc<SharedLink>,
}

#[pymethods]
impl Link {
    fn __eq__(&self, other: PyRef<'_, Link>) -> bool {
        Arc::ptr_eq(&self.core, &other.core)
    }

    fn __hash__(&self) -> usize {
        Arc::as_ptr(&self.core).addr()
    }

    #[pyo3(signature = (name, *, timeout, unit=None, withdrawal=None))]
    fn route(
        &self,
        name: &str,
        timeout: f64,
        unit: Option<i128>,
        withdrawal: Option<PyRef<'_, Withdrawal>>,
    ) -> PyResult<Route> {
        let core = CoreRoute {
            name: name.into(),
            link: Arc::clone(&self.core),
            unit_id: unit.map(|unit| byte("unit", unit)).transpose()?,
            timeout: seconds("timeout", timeout)?,
            withdrawal: withdrawal.map(|own| Arc::clone(&own.core)).unwrap_or_default(),
        };
        Ok(Route { core })
    }

    fn set_longest_wait(&self, wait: Option<f64>) -> PyResult<()> {
        self.core.set_longest_wait(wait.map(|wait| seconds("wait", wait)).transpose()?);
        Ok(())
    }

    #[allow(clippy::too_many_arguments, reason = "they are keywords in Python")]
    #[pyo3(signature = (caller, request, unit, timeout, *, broadcast=false, peers=None))]
    fn call(
        &self,
        caller: PyRef<'_, Caller>,
        request: PyRef<'_, Request>,
        unit: i128,
        timeout: f64,
        broadcast: bool,
        peers: Option<Vec<String>>,
    ) -> PyResult<Option<u64>> {
        let (unit_id, timeout) = (byte("unit", unit)?, seconds("timeout", timeout)?);
        let peers = peers.map(|all| ip_addresses("peers", &all)).transpose()?;
        let peers = peers.map_or_else(Peers::default, Peers::only);
        Ok(self.core.call(&caller.core, unit_id, &request.encoded, timeout, broadcast, peers))
    }

    #[getter]
    fn error(&self) -> Option<String> {
        self.core.error().map(|error| error.to_string())
    }

    fn counters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = self.core.counters.by_name().into_py_dict(py)?;
        all.set_item("waiting", self.core.waiting())?;
        add_strays(&all, self.core.strays())?;
        Ok(all)
    }
}

/// Adds the counters of unexpected and late data of a connection.
pub fn add_strays(all: &Bound<'_, PyDict>, strays: Option<&StrayCounters>) -> PyResult<()> {
    let count = |of: fn(&StrayCounters) -> u64| strays.map_or(0, of);
    all.set_item("unexpected_replies", count(|strays| strays.replies.get()))?;
    all.set_item("stray_bytes", count(|strays| strays.bytes.get()))?;
    all.set_item("late_replies", count(|strays| strays.late.get()))?;
    all.set_item("raised_timeouts", count(|strays| strays.raised_timeouts.get()))?;
    all.set_item("floods", count(|strays| strays.floods.get()))
}

/// Ticket, whether it was sent, and the result or an exception.
type Called<'py> = (u64, bool, Bound<'py, PyAny>);

#[pyclass(frozen, module = "holdfast")]
pub struct Caller {
    core: Arc<CoreCaller>,
    wakes: Mutex<Option<Wakes>>,
}

#[pymethods]
impl Caller {
    #[new]
    fn new() -> PyResult<Caller> {
        let (core, wakes) = CoreCaller::new()?;
        Ok(Caller { core, wakes: Mutex::new(Some(wakes)) })
    }

    fn detach(&self) -> PyResult<i64> {
        let wakes = lock(&self.wakes).take();
        let wakes = wakes.ok_or_else(|| PyRuntimeError::new_err("the socket has been detached"))?;
        Ok(handle(wakes))
    }

    fn take<'py>(&self, py: Python<'py>) -> PyResult<Vec<Called<'py>>> {
        let called = self.core.take().into_iter().map(|call| {
            let result = match call.outcome {
                Ok(pdu) => match response(&call.request, &pdu) {
                    Ok(response) => value(py, response)?,
                    Err(error) => exception(py, &error),
                },
                Err(error) => exception(py, &error),
            };
            Ok((call.ticket, call.is_sent, result))
        });
        called.collect()
    }

    fn withdraw(&self, ticket: u64) -> bool {
        self.core.withdraw(ticket)
    }
}

#[cfg(unix)]
pub(crate) fn handle(wakes: Wakes) -> i64 {
    i64::from(std::os::fd::IntoRawFd::into_raw_fd(wakes))
}

#[cfg(windows)]
pub(crate) fn handle(wakes: Wakes) -> i64 {
    std::os::windows::io::IntoRawSocket::into_raw_socket(wakes) as i64
}

/// Area, address, count, device, first address of the device, and whether function 22 is emulated.
type Passed = (String, u16, u32, String, u16, bool);

#[pyclass(frozen, module = "holdfast")]
pub struct Passage {
    pub(crate) core: Arc<CorePassage>,
}

#[pymethods]
impl Passage {
    fn device_of(&self, area: &str, address: u16, count: u32) -> PyResult<Option<&str>> {
        Ok(self.core.device_of(named(area)?, address, count))
    }

    /// Returns the code of the exception, `None` if the device has confirmed the write.
    fn write(
        &self,
        py: Python<'_>,
        area: &str,
        address: u16,
        values: Vec<u16>,
    ) -> PyResult<Option<u8>> {
        with_write(area, address, &values, |request| py.detach(|| self.core.write(request)).err())
    }

    fn call(
        &self,
        caller: PyRef<'_, Caller>,
        area: &str,
        address: u16,
        values: Vec<u16>,
    ) -> PyResult<u64> {
        with_write(area, address, &values, |request| self.core.call(&caller.core, request))
    }
}

/// Hands over the request that writes values.
fn with_write<T>(
    area: &str,
    address: u16,
    values: &[u16],
    then: impl FnOnce(&CoreRequest<'_>) -> T,
) -> PyResult<T> {
    let area = named(area)?;
    let most = if area.is_bits() { limit::WRITE_BITS } else { limit::WRITE_REGISTERS };
    within("number of values", values.len() as i128, 1..=most.into())?;
    let items: Vec<bool> = values.iter().map(|value| *value != 0).collect();
    let mut room = [0; pdu::MAX_LEN];
    let fits = "there are no more values than a request has room for";
    let request = match (area, values) {
        (Area::Coils, [value]) => CoreRequest::WriteSingleCoil { address, value: *value != 0 },
        (Area::Coils, _) => {
            let bits = Bits::pack(&items, &mut room).expect(fits);
            CoreRequest::WriteMultipleCoils { address, bits }
        }
        (Area::HoldingRegisters, [value]) => {
            CoreRequest::WriteSingleRegister { address, value: *value }
        }
        (Area::HoldingRegisters, values) => {
            let registers = Registers::pack(values, &mut room).expect(fits);
            CoreRequest::WriteMultipleRegisters { address, registers }
        }
        _ => {
            let name = area.name();
            return Err(PyValueError::new_err(format!("devices have no writable {name}")));
        }
    };
    Ok(then(&request))
}

/// The ranges of a memory whose writes go to devices.
pub(crate) fn passed(ranges: Vec<Passed>) -> PyResult<Vec<PassedRange>> {
    let ranges =
        ranges.into_iter().map(|(area, address, count, device, device_address, emulate)| {
            let (area, device) = (named(&area)?, device.into());
            Ok(PassedRange { area, address, count, device, device_address, emulate })
        });
    ranges.collect()
}

#[pyclass(frozen, module = "holdfast")]
pub struct Route {
    pub(crate) core: CoreRoute,
}

#[pyclass(frozen, module = "holdfast")]
pub struct Withdrawal {
    core: Arc<CoreWithdrawal>,
}

#[pymethods]
impl Withdrawal {
    #[new]
    fn new() -> Withdrawal {
        Withdrawal { core: Arc::default() }
    }

    fn withdraw(&self) {
        self.core.withdraw();
    }
}
