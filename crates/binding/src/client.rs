//! `Request`, `Endpoint` and `BlockingClient`: requests, and their results or exceptions.

use std::cell::{Cell, RefCell};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use holdfast_engine::client::{
    BlockingClient as Core, ClientError, Direction, Endpoint as CoreEndpoint, Lost, Place,
};
use holdfast_engine::tls::FileError;
use holdfast_engine::tls::client::{ClientSettings, ClientTls, TlsError};
use holdfast_engine::{LineDirection, LineMode, LineParity, SerialLine};
use holdfast_memory::{Area, Span};
use holdfast_protocol::client::{AcceptUnit, Closed, Echo, InvalidResponse as Invalid, Tolerance};
use holdfast_protocol::pdu::identification::ReadCode;
use holdfast_protocol::pdu::{
    self, Bits, Diagnostics, EncodedRequest, ExceptionCode, FileRange, FileRanges, FileRecords,
    Range, Registers, Request as CoreRequest, RequestError, Response, SubFunction, limit,
};
use pyo3::exceptions::{PyException, PyOSError, PyPermissionError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyBytes, PyList};
use pyo3::{PyTraverseError, PyVisit};

use crate::arguments::{byte, os_text, seconds, unknown, within, word};
use crate::memory::{Integer, integer, item, numbers};

pyo3::import_exception!(holdfast.errors, ModbusException);
pyo3::import_exception!(holdfast.errors, ConnectFailed);
pyo3::import_exception!(holdfast.errors, ConnectionLost);
pyo3::import_exception!(holdfast.errors, RequestTimeout);
pyo3::import_exception!(holdfast.errors, InvalidResponse);
pyo3::import_exception!(holdfast.errors, TlsFailed);

#[pyclass(frozen, module = "holdfast")]
pub struct Request {
    pub(crate) encoded: EncodedRequest,
}

#[pymethods]
impl Request {
    #[staticmethod]
    fn read(area: &str, address: Integer, count: Integer) -> PyResult<Request> {
        let area = crate::memory::named(area)?;
        Ok(encoded(&match area {
            Area::Coils => CoreRequest::ReadCoils(range(address, count)?),
            Area::DiscreteInputs => CoreRequest::ReadDiscreteInputs(range(address, count)?),
            Area::HoldingRegisters => CoreRequest::ReadHoldingRegisters(range(address, count)?),
            Area::InputRegisters => CoreRequest::ReadInputRegisters(range(address, count)?),
            Area::File(_) => unreachable!("it is one of the four areas"),
        }))
    }

    #[staticmethod]
    fn write_coil(address: Integer, value: &Bound<'_, PyAny>) -> PyResult<Request> {
        let address = register("address", address)?;
        let value = single(Area::Coils, value)? == 1;
        Ok(encoded(&CoreRequest::WriteSingleCoil { address, value }))
    }

    #[staticmethod]
    fn write_register(address: Integer, value: &Bound<'_, PyAny>) -> PyResult<Request> {
        let address = register("address", address)?;
        let value = single(Area::HoldingRegisters, value)?;
        Ok(encoded(&CoreRequest::WriteSingleRegister { address, value }))
    }

    #[staticmethod]
    fn write_coils(address: Integer, values: &Bound<'_, PyAny>) -> PyResult<Request> {
        let values = numbers("values", Area::Coils, values)?;
        let range = range::<{ limit::WRITE_BITS }>(address, Integer(values.len() as i128))?;
        let values: Vec<bool> = values.iter().map(|bit| *bit == 1).collect();
        let mut room = [0; pdu::MAX_LEN];
        let bits = Bits::pack(&values, &mut room).map_err(refused)?;
        Ok(encoded(&CoreRequest::WriteMultipleCoils { address: range.address(), bits }))
    }

    #[staticmethod]
    fn write_registers(address: Integer, values: &Bound<'_, PyAny>) -> PyResult<Request> {
        let values = numbers("values", Area::HoldingRegisters, values)?;
        let range = range::<{ limit::WRITE_REGISTERS }>(address, Integer(values.len() as i128))?;
        let mut room = [0; pdu::MAX_LEN];
        let registers = Registers::pack(&values, &mut room).map_err(refused)?;
        Ok(encoded(&CoreRequest::WriteMultipleRegisters { address: range.address(), registers }))
    }

    #[staticmethod]
    fn mask_write(address: Integer, and_mask: Integer, or_mask: Integer) -> PyResult<Request> {
        Ok(encoded(&CoreRequest::MaskWriteRegister {
            address: register("address", address)?,
            and_mask: register("and_mask", and_mask)?,
            or_mask: register("or_mask", or_mask)?,
        }))
    }

    #[staticmethod]
    fn read_write(
        read_address: Integer,
        count: Integer,
        write_address: Integer,
        values: &Bound<'_, PyAny>,
    ) -> PyResult<Request> {
        let values = numbers("values", Area::HoldingRegisters, values)?;
        let read = range(read_address, count)?;
        let written = Integer(values.len() as i128);
        let write_address =
            range::<{ limit::READ_WRITE_REGISTERS }>(write_address, written)?.address();
        let mut room = [0; pdu::MAX_LEN];
        let registers = Registers::pack(&values, &mut room).map_err(refused)?;
        Ok(encoded(&CoreRequest::ReadWriteMultipleRegisters { read, write_address, registers }))
    }

    #[staticmethod]
    fn diagnostics(sub_function: Integer, data: &Bound<'_, PyAny>) -> PyResult<Request> {
        let words = numbers("data", Area::HoldingRegisters, data)?;
        let data: Vec<u8> = words.iter().flat_map(|word| word.to_be_bytes()).collect();
        let known = u16::try_from(sub_function.0).ok().and_then(SubFunction::from_code);
        let sub_function = known.ok_or_else(|| {
            let allowed = SubFunction::ALL.iter().map(|each| each.code().to_string());
            let allowed = allowed.collect::<Vec<_>>().join(", ");
            PyValueError::new_err(format!("sub_function is {}, allowed: {allowed}", sub_function.0))
        })?;
        let query = Diagnostics::new(sub_function, &data).map_err(refused)?;
        Ok(encoded(&CoreRequest::Diagnostics(query)))
    }

    #[staticmethod]
    fn exception_status() -> Request {
        encoded(&CoreRequest::ReadExceptionStatus)
    }

    #[staticmethod]
    fn event_log() -> Request {
        encoded(&CoreRequest::GetCommEventLog)
    }

    #[staticmethod]
    fn read_files(ranges: Vec<(Integer, Integer, Integer)>) -> PyResult<Request> {
        let ranges = ranges
            .into_iter()
            .map(|(file, record, count)| file_range(file, record, count, limit::READ_RECORDS));
        let ranges = ranges.collect::<PyResult<Vec<_>>>()?;
        let mut room = [0; pdu::MAX_LEN];
        let ranges = FileRanges::pack(&ranges, &mut room).map_err(refused)?;
        Ok(encoded(&CoreRequest::ReadFileRecord(ranges)))
    }

    #[staticmethod]
    fn write_files(ranges: Vec<(Integer, Integer, Bound<'_, PyAny>)>) -> PyResult<Request> {
        let ranges = ranges.into_iter().map(|(file, record, values)| {
            let values = numbers("values", Area::HoldingRegisters, &values)?;
            let count = Integer(values.len() as i128);
            let range = file_range(file, record, count, limit::WRITE_RECORDS)?;
            Ok((range.file(), range.record(), values))
        });
        let ranges = ranges.collect::<PyResult<Vec<_>>>()?;
        let ranges: Vec<(u16, u16, &[u16])> =
            ranges.iter().map(|(file, record, values)| (*file, *record, &values[..])).collect();
        let mut room = [0; pdu::MAX_LEN];
        let records = FileRecords::pack(&ranges, &mut room).map_err(refused)?;
        Ok(encoded(&CoreRequest::WriteFileRecord(records)))
    }

    #[staticmethod]
    fn read_queue(address: Integer) -> PyResult<Request> {
        let address = register("address", address)?;
        Ok(encoded(&CoreRequest::ReadFifoQueue { address }))
    }

    #[staticmethod]
    fn of_function(code: Integer, data: &[u8]) -> PyResult<Request> {
        let code = within("function", code.0, 1..=0x7F)? as u8;
        within("len(data)", data.len() as i128, 0..=pdu::MAX_LEN - 1)?;
        let pdu = [&[code], data].concat();
        let encoded = EncodedRequest::opaque(&pdu).expect("a PDU of this length and code");
        Ok(Request { encoded })
    }

    #[staticmethod]
    fn event_counter() -> Request {
        encoded(&CoreRequest::GetCommEventCounter)
    }

    #[staticmethod]
    fn report_server_id() -> Request {
        encoded(&CoreRequest::ReportServerId)
    }

    #[staticmethod]
    fn identification(code: Integer, object_id: Integer) -> PyResult<Request> {
        let code = ReadCode::from_code(byte("code", code.0)?)
            .ok_or_else(|| PyValueError::new_err(format!("code is {}, allowed: 1 to 4", code.0)))?;
        let object_id = byte("object_id", object_id.0)?;
        Ok(encoded(&CoreRequest::ReadDeviceIdentification { code, object_id }))
    }

    #[getter]
    fn pdu<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, self.encoded.pdu())
    }

    fn as_multiple(&self) -> Option<Request> {
        self.encoded.as_multiple().map(|encoded| Request { encoded })
    }
}

/// The device address that a client or the poller connects to.
#[pyclass(frozen, module = "holdfast")]
pub struct Endpoint {
    pub core: CoreEndpoint,
}

#[pymethods]
#[allow(clippy::too_many_arguments, reason = "they are keywords in Python")]
impl Endpoint {
    #[staticmethod]
    fn network(py: Python<'_>, transport: &str, host: String, port: u16) -> PyResult<Endpoint> {
        let core = match transport {
            "tcp" => Place::Tcp { host, port, tls: None },
            "rtu+tcp" => Place::RtuOverTcp { host, port },
            "ascii+tcp" => Place::AsciiOverTcp { host, port },
            "udp" => Place::Udp { host, port },
            "rtu+udp" => Place::RtuOverUdp { host, port },
            _ => {
                let allowed = "tcp, rtu+tcp, ascii+tcp, udp, rtu+udp";
                return Err(unknown("transport", transport, allowed));
            }
        };
        Endpoint::new(py, core)
    }

    #[staticmethod]
    #[pyo3(signature = (host, port, ca=None, cert=None, key=None, name=None, decrypted_key=None))]
    fn tls(
        py: Python<'_>,
        host: String,
        port: u16,
        ca: Option<PathBuf>,
        cert: Option<PathBuf>,
        key: Option<PathBuf>,
        name: Option<&str>,
        decrypted_key: Option<&[u8]>,
    ) -> PyResult<Endpoint> {
        let own = match (cert.as_deref(), key.as_deref()) {
            (Some(cert), Some(key)) => Some((cert, key)),
            (None, None) => None,
            _ => return Err(PyValueError::new_err("cert and key: give both, or neither")),
        };
        let name = name.unwrap_or(&host);
        let settings = ClientSettings { ca: ca.as_deref(), own, decrypted_key, name };
        // Reading may block: let other Python threads run.
        let tls = py.detach(|| ClientTls::new(settings));
        let tls = Some(Arc::new(tls.map_err(unusable)?));
        Endpoint::new(py, Place::Tcp { host, port, tls })
    }

    #[staticmethod]
    #[pyo3(signature = (device, *, mode, baud, parity, stop_bits, data_bits, silence=None, rs485=None))]
    fn serial(
        py: Python<'_>,
        device: String,
        mode: &str,
        baud: i128,
        parity: &str,
        stop_bits: i128,
        data_bits: i128,
        silence: Option<f64>,
        rs485: Option<String>,
    ) -> PyResult<Endpoint> {
        let line = line(device, mode, baud, parity, stop_bits, data_bits, silence, rs485)?;
        Endpoint::new(py, Place::Serial(line))
    }

    #[pyo3(signature = (*, accept_unit=None, pad=false, echo=None, pause=0.0, pause_after_connect=0.0, retries=0, retry_busy=false, close_after=0, reconnect=0.0, write_multiple=false))]
    fn tolerating(
        &self,
        accept_unit: Option<&Bound<'_, PyAny>>,
        pad: bool,
        echo: Option<&Bound<'_, PyAny>>,
        pause: f64,
        pause_after_connect: f64,
        retries: i128,
        retry_busy: bool,
        close_after: i128,
        reconnect: f64,
        write_multiple: bool,
    ) -> PyResult<Endpoint> {
        let accept_unit = match accept_unit {
            None => AcceptUnit::Requested,
            Some(any) if any.extract().is_ok_and(|word: &str| word == "any") => AcceptUnit::Any,
            Some(unit) => AcceptUnit::Also(byte("accept_unit", integer(unit)?)?),
        };
        let echo = match echo {
            None => Echo::Auto,
            Some(auto) if auto.extract().is_ok_and(|word: &str| word == "auto") => Echo::Auto,
            Some(flag) if flag.extract::<bool>()? => Echo::Always,
            Some(_) => Echo::Never,
        };
        let tolerance = Tolerance {
            accept_unit,
            pad,
            echo,
            pause: seconds("pause", pause)?,
            pause_after_connect: seconds("pause_after_connect", pause_after_connect)?,
            retries: byte("retries", retries)?,
            retry_busy,
            close_after: within("close_after", close_after, 0..=65_535)? as u32,
            reconnect: seconds("reconnect", reconnect)?,
            write_multiple,
        };
        Ok(Endpoint { core: CoreEndpoint { place: self.core.place.clone(), tolerance } })
    }
}

impl Endpoint {
    fn new(py: Python<'_>, place: Place) -> PyResult<Endpoint> {
        import_exceptions(py)?;
        Ok(Endpoint { core: place.into() })
    }
}

/// Imports the exceptions that requests raise. While a program ends, nothing can be imported any more:
/// a request in a `__del__` that was the first to fail would abort the process.
fn import_exceptions(py: Python<'_>) -> PyResult<()> {
    static ARE_IMPORTED: PyOnceLock<()> = PyOnceLock::new();
    let import = || {
        py.import("holdfast.errors")?; // `get_type` panics if it can't.
        py.get_type::<ModbusException>();
        py.get_type::<ConnectFailed>();
        py.get_type::<ConnectionLost>();
        py.get_type::<RequestTimeout>();
        py.get_type::<InvalidResponse>();
        py.get_type::<TlsFailed>();
        Ok(())
    };
    ARE_IMPORTED.get_or_try_init(py, import).copied()
}

#[pyclass(frozen, module = "holdfast")]
pub struct BlockingClient {
    core: Core,
    tolerance: Tolerance,
    trace: Option<Arc<Py<PyAny>>>,
    /// How often calls were ended.
    ended: AtomicU64,
}

#[pymethods]
impl BlockingClient {
    #[new]
    #[pyo3(signature = (endpoint, trace=None))]
    fn new(endpoint: PyRef<'_, Endpoint>, trace: Option<Py<PyAny>>) -> BlockingClient {
        let core = Core::new(endpoint.core.clone());
        let trace = trace.map(Arc::new);
        let core = match trace.clone() {
            None => core,
            Some(trace) => core.traced(Arc::new(move |direction, bytes| {
                if let Some(raised) = show(&trace, direction, bytes) {
                    RAISED.set(Some(raised));
                }
            })),
        };
        let tolerance = endpoint.core.tolerance;
        BlockingClient { core, tolerance, trace, ended: AtomicU64::new(0) }
    }

    /// Sends a request and returns its result as a Python object. Once `is_cancelled` returns true, the
    /// call ends, unless its request was sent.
    #[pyo3(signature = (request, unit, timeout, is_cancelled=None))]
    fn call<'py>(
        &self,
        py: Python<'py>,
        request: &Request,
        unit: i128,
        timeout: f64,
        is_cancelled: Option<Py<PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let unit = byte("unit", unit)?;
        let timeout = seconds("timeout", timeout)?;
        // Its reply is parsed as one to the request that is sent.
        let adapted = self.tolerance.adapted(&request.encoded);
        let request = adapted.as_ref().unwrap_or(&request.encoded);
        let take = |_: Response<'_>, pdu: &[u8]| pdu.to_vec();
        let is_cancelled = || {
            let Some(is_cancelled) = &is_cancelled else { return false };
            // Without an answer, nothing is sent.
            let asked = Python::try_attach(|py| is_cancelled.call0(py)?.is_truthy(py));
            asked.is_none_or(|answer| answer.unwrap_or(true))
        };
        let may_send = |_| {
            let cancelled = || ClientError::Lost(Lost::Closed(Closed::BySelf));
            if is_cancelled() { Err(cancelled()) } else { Ok(()) }
        };
        let was_sent = AtomicBool::new(false);
        let is_over = || !was_sent.load(Ordering::Relaxed) && is_cancelled();
        let result = self.interruptible(py, is_over, |interrupted| {
            let called = (unit, request);
            self.core.interruptible_call(interrupted, &may_send, &was_sent, called, timeout, take)
        })?;
        let closed = || Err(ClientError::Lost(Lost::Closed(Closed::BySelf)));
        let pdu = result
            .unwrap_or_else(closed)
            .map_err(|error| of_request(py, &error, was_sent.load(Ordering::Relaxed)))?;
        value(py, response(request, &pdu).map_err(|error| to_py_err(&error))?)
    }

    /// Ends the call that waits for its reply, and its connection.
    fn end_call(&self) {
        self.ended.fetch_add(1, Ordering::Relaxed);
    }

    /// Within a call of this thread: a signal handler or the trace waits for nothing, and ends that call.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        if self.is_calling() {
            self.core.close_after_call();
            self.end_call();
            return Ok(());
        }
        self.interruptible(py, || false, |interrupted| self.core.close(Some(interrupted)))
    }

    #[getter]
    fn late(&self) -> u64 {
        self.core.late()
    }

    /// How many seconds the slowest late reply took; 0 if there were none.
    #[getter]
    fn longest_late(&self) -> f64 {
        self.core.longest_late().as_secs_f64()
    }

    /// A trace often belongs to the owner of the client. Such a cycle is broken at the owner.
    fn __traverse__(&self, visit: PyVisit<'_>) -> Result<(), PyTraverseError> {
        visit.call(self.trace.as_deref())
    }
}

thread_local! {
    /// The clients with a call in this thread, as addresses. Signal handlers and the trace run within
    /// a call: one that called its client, directly or within a call of another, would wait for ever. It
    /// can only close it.
    static CALLING: RefCell<Vec<usize>> = const { RefCell::new(Vec::new()) };

    /// What a signal handler has raised in the trace of a call in this thread.
    static RAISED: Cell<Option<PyErr>> = const { Cell::new(None) };
}

impl BlockingClient {
    /// Whether this thread is within a call of this client.
    fn is_calling(&self) -> bool {
        CALLING.with_borrow(|clients| clients.contains(&std::ptr::from_ref(self).addr()))
    }

    /// Runs `work` without the interpreter. While it waits, handlers of Python signals run; an
    /// exception of a handler ends it, as do `end_call` and `is_over`.
    fn interruptible<T: Send>(
        &self,
        py: Python<'_>,
        is_over: impl Fn() -> bool + Sync,
        work: impl FnOnce(&mut dyn FnMut() -> bool) -> T + Send,
    ) -> PyResult<T> {
        if self.is_calling() {
            let message = "this client is waiting for a reply: a signal handler or a trace \
                           can't use it, only close it";
            return Err(PyRuntimeError::new_err(message));
        }
        let mut raised = None;
        let ended = self.ended.load(Ordering::Relaxed);
        let is_ended = || self.ended.load(Ordering::Relaxed) != ended;
        CALLING.with_borrow_mut(|clients| clients.push(std::ptr::from_ref(self).addr()));
        let result = py.detach(|| {
            work(&mut || {
                if is_ended() || is_over() {
                    return true;
                }
                // Before the handlers: nothing that one of them raised is lost.
                raised = RAISED.take();
                if raised.is_none() {
                    // The end of the program has ended the interpreter: nobody waits for this call.
                    let Some(checked) = Python::try_attach(|py| py.check_signals()) else {
                        return true;
                    };
                    raised = checked.err();
                }
                raised.is_some() || is_ended()
            })
        });
        CALLING.with_borrow_mut(Vec::pop);
        let in_trace = RAISED.take();
        raised.or(in_trace).map_or(Ok(result), Err)
    }
}

/// Shows bytes to a function of Python. Its errors are only reported, because the device may have carried
/// out the request. Returns what else it raised: `KeyboardInterrupt`, for example. Shows nothing once
/// the end of the program has ended the interpreter.
pub fn show(trace: &Py<PyAny>, direction: Direction, bytes: &[u8]) -> Option<PyErr> {
    let word = match direction {
        Direction::Sent => "sent",
        Direction::Received => "received",
    };
    Python::try_attach(|py| {
        let trace = trace.bind(py);
        let error = trace.call1((word, PyBytes::new(py, bytes))).err()?;
        if !error.is_instance_of::<PyException>(py) {
            return Some(error);
        }
        error.write_unraisable(py, Some(trace));
        None
    })
    .flatten()
}

/// Maps a file that cannot be read to the `OSError` subclass that Python itself would raise.
fn unusable(error: TlsError) -> PyErr {
    match error {
        TlsError::File(FileError::Unreadable { file, error }) => match error.raw_os_error() {
            Some(code) => PyOSError::new_err((code, os_text(&error), file)),
            None => PyOSError::new_err(format!("{file}: {error}")),
        },
        other => PyValueError::new_err(other.to_string()),
    }
}

/// Checks the arguments of a serial line.
#[allow(clippy::too_many_arguments, reason = "they are keywords in Python")]
pub fn line(
    device: String,
    mode: &str,
    baud: i128,
    parity: &str,
    stop_bits: i128,
    data_bits: i128,
    silence: Option<f64>,
    rs485: Option<String>,
) -> PyResult<SerialLine> {
    let silence = silence.map(|silence| seconds("silence", silence)).transpose()?;
    let modes = [("rtu", LineMode::Rtu { silence }), ("ascii", LineMode::Ascii)];
    let parities =
        [("none", LineParity::None), ("even", LineParity::Even), ("odd", LineParity::Odd)];
    let directions = [("rts", LineDirection::Rts), ("rts-low", LineDirection::RtsLow)];
    let direction = rs485.map(|given| word("rs485", &given, &directions)).transpose()?;
    Ok(SerialLine {
        device,
        baud: within("baud", baud, 50..=4_000_000)? as u32,
        parity: word("parity", parity, &parities)?,
        stop_bits: within("stop_bits", stop_bits, 1..=2)? as u8,
        data_bits: within("data_bits", data_bits, 7..=8)? as u8,
        mode: word("mode", mode, &modes)?,
        direction: direction.unwrap_or(LineDirection::Adapter),
    })
}

/// The response that a PDU is. That of a broadcast is empty.
pub(crate) fn response<'p>(
    request: &EncodedRequest,
    pdu: &'p [u8],
) -> Result<Response<'p>, ClientError> {
    if pdu.is_empty() {
        return Ok(Response::Written);
    }
    request.response(pdu).map_err(|error| ClientError::Invalid(Invalid::Pdu(error)))
}

/// A response as a Python object.
pub(crate) fn value<'py>(py: Python<'py>, response: Response<'_>) -> PyResult<Bound<'py, PyAny>> {
    Ok(match response {
        Response::Bits(bits) => PyList::new(py, bits.iter().collect::<Vec<_>>())?.into_any(),
        Response::Registers(registers) => words(py, registers.as_bytes())?,
        Response::Queue(registers) => words(py, registers.map_or(&[][..], |each| each.as_bytes()))?,
        Response::Written => py.None().into_bound(py),
        Response::Diagnostics(data) | Response::ServerId(data) | Response::Opaque(data) => {
            PyBytes::new(py, data).into_any()
        }
        Response::EventCounter { busy, events } => (busy, events).into_pyobject(py)?.into_any(),
        Response::ExceptionStatus(outputs) => outputs.into_pyobject(py)?.into_any(),
        Response::EventLog { busy, events, messages, log } => {
            (busy, events, messages, PyBytes::new(py, log)).into_pyobject(py)?.into_any()
        }
        Response::FileRecords(answer) => {
            let ranges = answer.iter().map(|records| words(py, records));
            PyList::new(py, ranges.collect::<PyResult<Vec<_>>>()?)?.into_any()
        }
        Response::Identification(answer) => {
            let objects = answer.iter().map(|(id, value)| (id, PyBytes::new(py, value)));
            let objects: Vec<(u8, Bound<'_, PyBytes>)> = objects.collect();
            (answer.conformity_level, answer.next, objects).into_pyobject(py)?.into_any()
        }
    })
}

fn words<'py>(py: Python<'py>, registers: &[u8]) -> PyResult<Bound<'py, PyAny>> {
    let (pairs, _) = registers.as_chunks::<2>();
    Ok(PyList::new(py, pairs.iter().map(|pair| u16::from_be_bytes(*pair)))?.into_any())
}

/// The Python exception of an error, as an object.
pub(crate) fn exception<'py>(py: Python<'py>, error: &ClientError) -> Bound<'py, PyAny> {
    to_py_err(error).into_value(py).into_bound(py).into_any()
}

/// Maps an error to its Python exception.
pub(crate) fn to_py_err(error: &ClientError) -> PyErr {
    let text = error.to_string();
    match error {
        ClientError::Exception(code) => {
            let name = ExceptionCode::from_code(*code).map(ExceptionCode::name);
            ModbusException::new_err((*code, name))
        }
        ClientError::Timeout(_) | ClientError::Incomplete(_) => RequestTimeout::new_err(text),
        ClientError::NoSilence(_)
        | ClientError::ConnectTimeout { .. }
        | ClientError::LookupTimeout { .. } => RequestTimeout::new_err((text, false)),
        ClientError::Connect { to, error } => {
            ConnectFailed::new_err((to.clone(), os_text(error), error.raw_os_error()))
        }
        ClientError::Tls { to, failure, maybe_sent } => {
            let of = (failure.reason(), to.clone(), failure.to_string(), *maybe_sent);
            TlsFailed::new_err(of)
        }
        ClientError::Lost(_) | ClientError::Fenced | ClientError::Expired => {
            ConnectionLost::new_err(text)
        }
        ClientError::Elsewhere => PyPermissionError::new_err(text),
        ClientError::Invalid(invalid) => InvalidResponse::new_err((text, invalid.reason())),
    }
}

/// As `to_py_err`, for the error of a request. Errors of TLS say themselves whether it may have been sent.
pub(crate) fn of_request(py: Python<'_>, error: &ClientError, maybe_sent: bool) -> PyErr {
    let raised = to_py_err(error);
    if maybe_sent || !matches!(error, ClientError::Lost(_)) {
        return raised;
    }
    raised.value(py).setattr("maybe_sent", false).map_or_else(|failed| failed, |()| raised)
}

fn encoded(request: &CoreRequest<'_>) -> Request {
    Request { encoded: EncodedRequest::new(request) }
}

fn range<const MAX: u16>(address: Integer, Integer(count): Integer) -> PyResult<Range<MAX>> {
    let address = register("address", address)?;
    let quantity = within("count", count, 1..=usize::from(MAX))? as u16;
    if i128::from(address) + count > i128::from(Span::MAX_SIZE) {
        let message = format!("{count} from address {address}: the last address is 65535");
        return Err(PyValueError::new_err(message));
    }
    Range::new(address, quantity).map_err(refused)
}

fn file_range(file: Integer, record: Integer, count: Integer, most: u16) -> PyResult<FileRange> {
    let last = limit::LAST_RECORD;
    let file = within("file", file.0, 1..=usize::from(u16::MAX))? as u16;
    let record = within("record", record.0, 0..=usize::from(last))? as u16;
    let quantity = within("count", count.0, 1..=usize::from(most))? as u16;
    if record + quantity - 1 > last {
        let message = format!("{quantity} from record {record}: the last record is {last}");
        return Err(PyValueError::new_err(message));
    }
    FileRange::new(file, record, quantity).map_err(refused)
}

fn refused(error: RequestError) -> PyErr {
    PyValueError::new_err(error.to_string())
}

fn register(what: &str, Integer(number): Integer) -> PyResult<u16> {
    Ok(within(what, number, 0..=65_535)? as u16)
}

/// Extracts and checks the value of one bit or register.
fn single(area: Area, value: &Bound<'_, PyAny>) -> PyResult<u16> {
    item(area, value).or_else(|unfit| Err(unfit.error(area, "value", value)?))
}
