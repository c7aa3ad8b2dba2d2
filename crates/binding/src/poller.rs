//! `PolledDevice` and `Poller`: polling, its results and counters; `plan_blocks`: plans.

use std::borrow::Cow;
use std::sync::Arc;
use std::time::{Instant, SystemTime};

use holdfast_engine::client::Place;
use holdfast_engine::link::Fault;
use holdfast_engine::poller::plan::{self, Field, PlanLimits, Strategy, Stretch};
use holdfast_engine::poller::{
    self, Batch, BlockSettings, Destination, DeviceSettings, DeviceState, ForwardSettings, Poll,
    Polled, Poller as Core, PollerError, ReadSettings, StatusSettings,
};
use holdfast_memory::{Refusal, Span};
use holdfast_protocol::pdu::limit;
use holdfast_runtime::Retry;
use pyo3::exceptions::{PyOSError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyBytes, PyDict};

use crate::arguments::{byte, packet_format, seconds, within};
use crate::client::{Endpoint, Request};
use crate::heartbeat;
use crate::lease_fence::Fence;
use crate::link::{self, Link, Passage};
use crate::memory::{Memory, named};
use crate::mirror_age::MirrorAge;

const MAX_REGISTERS: i128 = limit::READ_REGISTERS as i128;
const MAX_BITS: i128 = limit::READ_BITS as i128;

/// An area, the first address of a range, and the address after its last.
type Range = (String, u32, u32);

/// A memory, an area and an address, and the age of the values there.
type Target<'py> = (PyRef<'py, Memory>, String, u16, Option<PyRef<'py, MirrorAge>>);

/// An area, an address, a count, and the destination of the bytes.
type Read<'py> = (String, i128, i128, Option<Target<'py>>);

/// Area and slot of a status block, its name, and whether it keeps the last error.
type StatusBlock = (String, u16, String, bool);

/// Format, crc, unit or memory id, timeout, offsets by area, and the status block with its unit or
/// memory id.
type Forward = (String, String, u16, f64, Vec<(String, u16)>, Option<(u16, StatusBlock)>);

/// Area, address, count, indexes of fields, number of items that no field covers.
type PlannedBlock = (Cow<'static, str>, u16, u16, Vec<usize>, u32);

#[pyclass(frozen, module = "holdfast")]
pub struct PolledDevice {
    core: DeviceSettings,
}

#[pymethods]
#[allow(clippy::too_many_arguments, reason = "they are keywords in Python")]
impl PolledDevice {
    #[new]
    #[pyo3(signature = (name, endpoint, *, unit, interval, timeout, reads, max_gap=None, cost=None, max_registers=MAX_REGISTERS, max_bits=MAX_BITS, readable=None, forbidden=None, forward=None, status=None, start_within=None, in_flight=1, receiver=None, reported_as=None, fields=None, release=false, measured=false, retry=None, jitter=true, fence=None))]
    fn new(
        name: String,
        endpoint: PyRef<'_, Endpoint>,
        unit: i128,
        interval: f64,
        timeout: f64,
        reads: Vec<Read<'_>>,
        max_gap: Option<i128>,
        cost: Option<(f64, f64)>,
        max_registers: i128,
        max_bits: i128,
        readable: Option<Vec<Range>>,
        forbidden: Option<Vec<Range>>,
        forward: Option<Vec<(PyRef<'_, Endpoint>, Forward)>>,
        status: Option<(PyRef<'_, Memory>, StatusBlock)>,
        start_within: Option<f64>,
        in_flight: Option<i128>,
        receiver: Option<PyRef<'_, PollReceiver>>,
        reported_as: Option<String>,
        fields: Option<Vec<(String, u32, u32)>>,
        release: bool,
        measured: bool,
        retry: Option<(f64, f64)>,
        jitter: bool,
        fence: Option<PyRef<'_, Fence>>,
    ) -> PyResult<PolledDevice> {
        let checked_range = |area: String, address, count| -> PyResult<_> {
            let address = within("address", address, 0..=65_535)? as u16;
            Ok((
                named(&area)?,
                address,
                within("count", count, 1..=Span::MAX_SIZE as usize)? as u32,
            ))
        };
        let reads = reads.into_iter().map(|(area, address, count, into)| {
            let (area, address, count) = checked_range(area, address, count)?;
            let into = into.map(destination).transpose()?;
            Ok(ReadSettings { area, address, count, into, forward: true })
        });
        let fields = fields.unwrap_or_default().into_iter().map(|(area, address, count)| {
            let (area, address, count) = checked_range(area, address.into(), count.into())?;
            Ok(ReadSettings { area, address, count, into: None, forward: false })
        });
        let forward = forward.unwrap_or_default().into_iter().map(forwarding);
        let status = status.map(|(memory, of)| self::status(&memory, of));
        let core = DeviceSettings {
            name,
            endpoint: endpoint.core.clone(),
            in_flight: link::in_flight(in_flight)?,
            retry: Retry { jitter, ..link::retry(retry)? },
            unit_id: byte("unit", unit)?,
            interval: seconds("interval", interval)?,
            timeout: seconds("timeout", timeout)?,
            reads: reads.chain(fields).collect::<PyResult<_>>()?,
            limits: limits(max_registers, max_bits, readable, forbidden)?,
            strategy: strategy(max_gap, cost)?,
            forward: forward.collect::<PyResult<_>>()?,
            status: status.transpose()?,
            start_within: match start_within {
                Some(within) => seconds("start_within", within)?,
                None => poller::first_poll_spread(seconds("interval", interval)?),
            },
            report: receiver.map(|receiver| Arc::clone(&receiver.core)),
            reported_as,
            release,
            measured,
            fence: fence.map(|fence| Arc::clone(&fence.core)),
        };
        Ok(PolledDevice { core })
    }
}

#[pyclass(frozen, module = "holdfast")]
pub struct Poller {
    core: Core,
}

#[pymethods]
impl Poller {
    #[new]
    fn new(py: Python<'_>, devices: Vec<PyRef<'_, PolledDevice>>) -> PyResult<Poller> {
        let devices: Vec<DeviceSettings> =
            devices.iter().map(|device| device.core.clone()).collect();
        let core = py.detach(|| Core::start(devices)).map_err(to_py_err)?;
        Ok(Poller { core })
    }

    #[getter]
    fn heartbeat(&self) -> (String, f64, Option<u32>) {
        heartbeat::to_python(self.core.heartbeat())
    }

    fn add(&self, device: PyRef<'_, PolledDevice>) -> PyResult<()> {
        self.core.add(device.core.clone()).map_err(to_py_err)
    }

    #[pyo3(signature = (name, device, *, at_once=true))]
    fn replace(&self, name: &str, device: PyRef<'_, PolledDevice>, at_once: bool) -> PyResult<()> {
        self.core.replace(name, device.core.clone(), at_once).map_err(to_py_err)
    }

    #[pyo3(signature = (name, request, receiver, *, within=None))]
    fn write(
        &self,
        name: &str,
        request: PyRef<'_, Request>,
        receiver: PyRef<'_, PollReceiver>,
        within: Option<f64>,
    ) -> PyResult<u64> {
        let within = within.map(|within| seconds("within", within)).transpose()?;
        let until = within.map(|within| Instant::now() + within);
        self.core
            .write(name, Box::new(request.encoded.clone()), until, &receiver.core)
            .map_err(to_py_err)
    }

    fn new_receiver(&self) -> PollReceiver {
        PollReceiver { core: self.core.receiver() }
    }

    #[pyo3(signature = (endpoint, *, in_flight=1, queue=None, coalesce=true, cache=0.0, preferred=None, retry=None))]
    #[allow(clippy::too_many_arguments, reason = "they are keywords in Python")]
    fn link(
        &self,
        endpoint: PyRef<'_, Endpoint>,
        in_flight: Option<i128>,
        queue: Option<i128>,
        coalesce: bool,
        cache: f64,
        preferred: Option<Vec<String>>,
        retry: Option<(f64, f64)>,
    ) -> PyResult<Link> {
        let preferred = preferred.unwrap_or_default();
        let settings =
            link::settings(&endpoint, (in_flight, retry), queue, coalesce, cache, &preferred)?;
        Ok(Link { core: self.core.link(settings).map_err(to_py_err)? })
    }

    fn link_if_used(&self, endpoint: PyRef<'_, Endpoint>) -> PyResult<Option<Link>> {
        let used = self.core.link_if_used(endpoint.core.clone()).map_err(to_py_err)?;
        Ok(used.map(|core| Link { core }))
    }

    fn forget_links(&self, used: Vec<PyRef<'_, Link>>) -> PyResult<()> {
        let used: Vec<_> = used.iter().map(|link| Arc::clone(&link.core)).collect();
        self.core.forget_links(&used).map_err(to_py_err)
    }

    fn passage(
        &self,
        memory: PyRef<'_, Memory>,
        ranges: Vec<(String, u16, u32, String, u16, bool)>,
    ) -> PyResult<Passage> {
        let passage = self.core.passage(Arc::clone(&memory.core), link::passed(ranges)?);
        Ok(Passage { core: Arc::new(passage.map_err(to_py_err)?) })
    }

    fn remove(&self, name: &str) -> bool {
        self.core.remove(name)
    }

    #[pyo3(signature = (*, receiver=None))]
    fn counters<'py>(
        &self,
        py: Python<'py>,
        receiver: Option<PyRef<'_, PollReceiver>>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        let is_of = |device: &Polled| match &receiver {
            Some(of) => device.report.as_ref().is_some_and(|to| Arc::ptr_eq(to, &of.core)),
            None => true,
        };
        for device in self.core.devices().into_iter().filter(is_of) {
            let counted = device_state_to_python(py, &device.state)?;
            let mut forwards = Vec::new();
            for forward in &device.forwards {
                let counters = forward.by_name().into_py_dict(py)?;
                let failure = forward.failure();
                let reason = failure.as_ref().and_then(|failure| failure.reason);
                counters.set_item("reason", reason)?;
                counters.set_item("error", failure.map(|failure| failure.text))?;
                forwards.push(counters);
            }
            counted.set_item("forward", forwards)?;
            all.set_item(&device.name, counted)?;
        }
        Ok(all)
    }

    fn stop(&self, py: Python<'_>) {
        py.detach(|| self.core.stop());
    }
}

#[pyclass(frozen, module = "holdfast")]
pub struct PollReceiver {
    core: Arc<poller::Results>,
}

#[pymethods]
impl PollReceiver {
    fn take<'py>(&self, py: Python<'py>, timeout: f64) -> PyResult<Option<Taken<'py>>> {
        let timeout = seconds("timeout", timeout)?;
        let Batch { polls, writes, ended, .. } = py.detach(|| self.core.take(timeout));
        if ended && polls.is_empty() && writes.is_empty() {
            return Ok(None);
        }
        let polls = polls.iter().map(|poll| poll_to_python(py, poll)).collect::<PyResult<_>>()?;
        let writes = writes.iter();
        let writes = writes.map(|done| (done.ticket, done.outcome.err().map_or(0, Fault::code)));
        Ok(Some((polls, writes.collect())))
    }

    fn wake(&self) {
        self.core.wake();
    }

    fn withdraw(&self) {
        self.core.withdraw();
    }

    #[getter]
    fn dropped(&self) -> u64 {
        self.core.dropped()
    }
}

fn to_py_err(error: PollerError) -> PyErr {
    match error {
        PollerError::Thread(_) => PyOSError::new_err(error.to_string()),
        PollerError::Stopped => PyRuntimeError::new_err(error.to_string()),
        _ => PyValueError::new_err(error.to_string()),
    }
}

/// Plans the requests that read all fields.
#[pyfunction]
#[pyo3(signature = (fields, *, max_gap=None, cost=None, max_registers=MAX_REGISTERS, max_bits=MAX_BITS, readable=None, forbidden=None))]
pub fn plan_blocks(
    fields: Vec<(String, i128, i128)>,
    max_gap: Option<i128>,
    cost: Option<(f64, f64)>,
    max_registers: i128,
    max_bits: i128,
    readable: Option<Vec<Range>>,
    forbidden: Option<Vec<Range>>,
) -> PyResult<Vec<PlannedBlock>> {
    let fields = fields.into_iter().map(|(area, address, count)| {
        Ok(Field {
            area: named(&area)?,
            address: within("address", address, 0..=65_535)? as u16,
            // No request carries as many.
            count: within("count", count, 1..=65_535)? as u16,
        })
    });
    let fields = fields.collect::<PyResult<Vec<Field>>>()?;
    let limits = limits(max_registers, max_bits, readable, forbidden)?;
    let blocks = plan::plan(&fields, &limits, strategy(max_gap, cost)?)
        .map_err(|error| PyValueError::new_err(error.to_string()))?;
    let blocks = blocks.into_iter();
    Ok(blocks
        .map(|block| (block.area.name(), block.address, block.count, block.fields, block.gaps))
        .collect())
}

fn destination((memory, area, address, age): Target<'_>) -> PyResult<Destination> {
    let age = age.map(|age| Arc::clone(&age.core));
    Ok(Destination { memory: Arc::clone(&memory.core), area: named(&area)?, address, age })
}

/// Writes the status block of a device that is not polled.
#[pyfunction]
pub fn write_disabled_status(
    py: Python<'_>,
    memory: PyRef<'_, Memory>,
    block: StatusBlock,
) -> PyResult<()> {
    let status = status(&memory, block)?;
    // The file or log of the memory may be slow.
    py.detach(|| status.write_disabled_status()).map_err(|refusal| match refusal {
        Refusal::OutOfRange => {
            PyValueError::new_err("the status block does not fit into its memory")
        }
        other => PyOSError::new_err(other.to_string()),
    })
}

fn status(memory: &Memory, of: StatusBlock) -> PyResult<StatusSettings> {
    Ok(StatusSettings { memory: Arc::clone(&memory.core), block: block(of)? })
}

fn block((area, slot, name, keep_last_error): StatusBlock) -> PyResult<BlockSettings> {
    Ok(BlockSettings { area: named(&area)?, slot, name, keep_last_error })
}

fn forwarding((endpoint, forward): (PyRef<'_, Endpoint>, Forward)) -> PyResult<ForwardSettings> {
    let (format, crc, target, timeout, offsets, status) = forward;
    let Place::Tcp { host, port, tls } = endpoint.core.place.clone() else {
        let message = "forward: the transport of the endpoint is not supported, allowed: tcp, tls";
        return Err(PyValueError::new_err(message));
    };
    let format = packet_format(&format, &crc)?;
    let timeout = seconds("timeout", timeout)?;
    let offsets = offsets.into_iter().map(|(area, offset)| Ok((named(&area)?, offset)));
    let offsets = offsets.collect::<PyResult<_>>()?;
    let status = status.map(|(target, of)| Ok::<_, PyErr>((target, block(of)?))).transpose()?;
    Ok(ForwardSettings { host, port, tls, format, target, timeout, offsets, status })
}

fn strategy(max_gap: Option<i128>, cost: Option<(f64, f64)>) -> PyResult<Strategy> {
    match (max_gap, cost) {
        (Some(_), Some(_)) => Err(PyValueError::new_err("max_gap and cost: give one, or neither")),
        (None, Some((request, item))) if request >= 0.0 && item >= 0.0 => {
            Ok(Strategy::Cost { request, item })
        }
        (None, Some((request, item))) => {
            let allowed = "two numbers, 0 or more";
            Err(PyValueError::new_err(format!("cost is {request}, {item}, allowed: {allowed}")))
        }
        (gap, None) => {
            let max_gap = within("max_gap", gap.unwrap_or_default(), 0..=65_535)? as u16;
            Ok(Strategy::Gap { max_gap })
        }
    }
}

fn limits(
    max_registers: i128,
    max_bits: i128,
    readable: Option<Vec<Range>>,
    forbidden: Option<Vec<Range>>,
) -> PyResult<PlanLimits> {
    let stretches = |ranges: Option<Vec<Range>>| {
        let ranges = ranges.unwrap_or_default().into_iter();
        ranges
            .map(|(area, start, end)| Ok(Stretch { area: named(&area)?, start, end }))
            .collect::<PyResult<Vec<Stretch>>>()
    };
    Ok(PlanLimits {
        max_registers: within("max_registers", max_registers, 1..=limit::READ_REGISTERS.into())?
            as u16,
        max_bits: within("max_bits", max_bits, 1..=limit::READ_BITS.into())? as u16,
        readable: stretches(readable)?,
        forbidden: stretches(forbidden)?,
        cuts: Vec::new(),
    })
}

/// Poll results, and writes as ticket and fault.
type Taken<'py> = (Vec<PollResult<'py>>, Vec<(u64, u16)>);

/// Device name, scheduled time in seconds, and blocks: area, address, count, bytes or fault, and
/// seconds since 1970.
type PollResult<'py> = (String, f64, Vec<ReportedBlock<'py>>);
type ReportedBlock<'py> = (Cow<'static, str>, u16, u16, Option<Bound<'py, PyBytes>>, u16, f64);

fn poll_to_python<'py>(py: Python<'py>, poll: &Poll) -> PyResult<PollResult<'py>> {
    let blocks = poll.blocks.iter().map(|block| {
        let (bytes, fault) = match &block.outcome {
            Ok(bytes) => (Some(PyBytes::new(py, bytes)), 0),
            Err(fault) => (None, fault.code()),
        };
        let time = match block.time.duration_since(SystemTime::UNIX_EPOCH) {
            Ok(since) => since.as_secs_f64(),
            Err(error) => -error.duration().as_secs_f64(),
        };
        (block.area.name(), block.address, block.count, bytes, fault, time)
    });
    Ok((poll.device.to_string(), poll.due.as_secs_f64(), blocks.collect()))
}

fn device_state_to_python<'py>(
    py: Python<'py>,
    state: &DeviceState,
) -> PyResult<Bound<'py, PyDict>> {
    let shown = PyDict::new(py);
    shown.set_item("health", state.health().name())?;
    shown.set_item("last_error", state.last_error())?;
    shown.set_item("error", state.error())?;
    shown.set_item("seconds_in_error", state.in_error().as_secs_f64())?;
    shown.set_item("age", state.age().map(|age| age.as_secs_f64()))?;
    shown.set_item("failures", state.failures())?;
    shown.set_item("round_trip", state.round_trip().as_secs_f64())?;
    shown.set_item("requests_per_poll", state.requests_per_poll())?;
    shown.set_item("plan_error", state.plan_error())?;
    for (key, count) in state.counters.by_name() {
        shown.set_item(key, count)?;
    }
    link::add_strays(&shown, Some(&state.strays()))?;
    Ok(shown)
}
