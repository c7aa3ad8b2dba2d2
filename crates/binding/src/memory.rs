//! `Memory`: converts between Python values and bytes in memory.

use std::collections::BTreeMap;
use std::sync::Arc;

use holdfast_memory::{
    Access, Area, Freshness, Gate, GateMode, Layout, Memory as Core, Mirrored, Read, Refusal, Span,
    Write,
};
use holdfast_protocol::pdu::limit;
use pyo3::exceptions::{PyIndexError, PyOSError, PyOverflowError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{
    PyBool, PyByteArray, PyBytes, PyDict, PyFrozenSet, PyInt, PyList, PyMapping, PyMemoryView,
    PySequence, PySet, PyString,
};

use crate::arguments::{within, word};
use crate::mirror_age::MirrorAge;
use crate::python_values::listed;
use crate::write_queue::WriteQueue;

pyo3::create_exception!(
    holdfast,
    OutOfRange,
    PyIndexError,
    "The range is not inside the area. Nothing was read or written."
);

pyo3::create_exception!(
    holdfast._core,
    Stale,
    PyOSError,
    "The range mirrors a device, and its values are older than allowed."
);

#[derive(FromPyObject)]
enum Seal {
    Once(String, Integer),
    Mode(String, Integer, String),
}

/// Four areas of bits and 16-bit registers, of fixed size, initially 0.
///
/// An area is a size (addresses from 0), or start and size; an omitted area does not exist.
/// `start + size` is at most 65536. `files` maps numbers of files, 1 to 65535, to their numbers of
/// records, 1 to 10000; `read` and `write` have them as the areas `file:NUMBER`. Every read sees a
/// whole write or none of it, and a refused write changes nothing. Methods are thread-safe.
///
/// `seal` is the gate bit, in coils or discrete inputs. Modbus clients receive exception 06 until a
/// write other than by Modbus sets that bit to 1: permanently (`once`), or while it is 1 (`level`).
/// `name` is its name in the audit log.
///
/// Raises `ValueError` for an invalid size or gate bit.
#[pyclass(frozen, module = "holdfast")]
pub struct Memory {
    pub core: Arc<Core>,
}

#[pymethods]
impl Memory {
    #[new]
    #[pyo3(signature = (*, coils=None, discrete_inputs=None, holding_registers=None, input_registers=None, files=None, seal=None, name=None))]
    fn new(
        coils: Option<Bound<'_, PyAny>>,
        discrete_inputs: Option<Bound<'_, PyAny>>,
        holding_registers: Option<Bound<'_, PyAny>>,
        input_registers: Option<Bound<'_, PyAny>>,
        files: Option<Bound<'_, PyDict>>,
        seal: Option<Seal>,
        name: Option<&str>,
    ) -> PyResult<Memory> {
        let extents = [coils, discrete_inputs, holding_registers, input_registers];
        let mut layout = Layout::default();
        for (area, extent) in Area::ALL.into_iter().zip(extents) {
            let Some(extent) = extent else { continue };
            let name = area.name();
            let (start, size) = start_and_size(&name, &extent)?;
            let start = within(&format!("start of {name}"), start, 0..=65_535)? as u16;
            let size = within(&format!("size of {name}"), size, 0..=65_536)? as u32;
            let span = Span::new(start, size)
                .map_err(|error| PyValueError::new_err(format!("{name}: {error}")))?;
            layout = layout.with(area, span);
        }
        for (number, records) in files.iter().flatten() {
            let number = within("file", integer(&number)?, 1..=usize::from(u16::MAX))? as u16;
            let most = usize::from(limit::LAST_RECORD) + 1;
            let records = within("number of records", integer(&records)?, 1..=most)? as u32;
            let span =
                Span::new(0, records).map_err(|error| PyValueError::new_err(error.to_string()))?;
            layout = layout.with(Area::File(number), span);
        }
        let gate = seal.map(gate).transpose()?;
        let core = Core::new(layout, gate)
            .map_err(|error| PyValueError::new_err(format!("seal: {error}")))?;
        let core = match name {
            Some(name) => core.named(name),
            None => core,
        };
        Ok(Memory { core: Arc::new(core) })
    }

    /// The addresses of each area that exists.
    #[getter]
    fn areas<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let areas = PyDict::new(py);
        for area in Area::ALL {
            let span = self.core.span(area);
            if span.size() > 0 {
                let range =
                    py.get_type::<pyo3::types::PyRange>().call1((span.start(), span.end()))?;
                areas.set_item(area.name(), range)?;
            }
        }
        Ok(areas)
    }

    /// The number of records of each file.
    #[getter]
    fn files(&self) -> BTreeMap<u16, u32> {
        let layout = self.core.layout();
        let files = layout.areas().filter_map(|area| match area {
            Area::File(number) => Some((number, layout.span(area).size())),
            _ => None,
        });
        files.collect()
    }

    /// Reserves ranges (area, address, count) for the poller; others can't write them any more.
    ///
    /// `aging` are ranges whose age is known, reserved or not; while one is too old, only the
    /// poller uses it. Both replace those of an earlier call. Raises `ValueError` for a range
    /// outside its area.
    #[pyo3(signature = (reserved, aging=Vec::new()))]
    fn mirror(
        &self,
        reserved: Vec<(String, u16, usize)>,
        aging: Vec<(String, u16, usize, PyRef<'_, MirrorAge>)>,
    ) -> PyResult<()> {
        let reserved = reserved
            .into_iter()
            .map(|(area, address, count)| Ok(Mirrored::reserved(named(&area)?, address, count)));
        let aging = aging.into_iter().map(|(area, address, count, age)| {
            let freshness = Some(Arc::clone(&age.core) as Arc<dyn Freshness>);
            Ok(Mirrored { area: named(&area)?, address, count, is_reserved: false, freshness })
        });
        let ranges = reserved.chain(aging).collect::<PyResult<_>>()?;
        self.core.mirror(ranges).map_err(|error| PyValueError::new_err(error.to_string()))
    }

    /// Whether the memory is sealed, so Modbus clients receive exception 06.
    #[getter]
    fn sealed(&self, py: Python<'_>) -> bool {
        py.detach(|| self.core.sealed())
    }

    /// Whether a write waits until it is kept: in a file, or in a log.
    #[getter]
    fn waits(&self) -> bool {
        self.core.has_journal()
    }

    /// How often the seal opened, and how often it closed again.
    #[getter]
    fn seal_changes(&self, py: Python<'_>) -> (u64, u64) {
        py.detach(|| self.core.seal_changes())
    }

    /// Reads `count` bits (0 or 1) or registers (0 to 65535) from `address`, as one snapshot.
    ///
    /// Raises `OutOfRange` outside the area, `ValueError` for an unknown area or a count below 1,
    /// `OSError` while the log of the memory does not let it be read, or the values of a mirrored
    /// device are too old.
    fn read<'py>(
        &self,
        py: Python<'py>,
        area: &str,
        address: &Bound<'_, PyAny>,
        count: &Bound<'_, PyAny>,
    ) -> PyResult<Bound<'py, PyList>> {
        let mut range = Range::new(&self.core, area, integer(address)?, integer(count)?)?;
        py.detach(|| self.core.read(Access::Ingest, range.reading()))
            .map_err(|refusal| range.refused(&self.core, refusal))?;
        range.values(py)
    }

    /// Reads several ranges (area, address, count) as one snapshot. Raises like `read`.
    fn read_many<'py>(
        &self,
        py: Python<'py>,
        ranges: Vec<(String, Bound<'py, PyAny>, Bound<'py, PyAny>)>,
    ) -> PyResult<Vec<Bound<'py, PyList>>> {
        let ranges = ranges.iter().map(|(area, address, count)| {
            Range::new(&self.core, area, integer(address)?, integer(count)?)
        });
        let mut ranges = ranges.collect::<PyResult<Vec<Range>>>()?;
        py.detach(|| {
            let mut reads: Vec<Read> = ranges.iter_mut().map(Range::reading).collect();
            self.core.read_many(Access::Ingest, &mut reads)
        })
        .map_err(|refused| ranges[refused.index].refused(&self.core, refused.refusal))?;
        ranges.iter().map(|range| range.values(py)).collect()
    }

    /// Writes bits (0, 1, False, True) or registers (integers 0 to 65535) in one step.
    ///
    /// Raises `OutOfRange` outside the area, `ValueError` for no values, a value out of range, an
    /// unknown area or a reserved range, `TypeError` for a value of another type, `OSError` if the
    /// memory is kept in a file or a log that can't be written, or the values of a mirrored device
    /// are too old. An error changes nothing, except that a log may still carry out a write that it
    /// did not confirm in time.
    fn write(
        &self,
        py: Python<'_>,
        area: &str,
        address: &Bound<'_, PyAny>,
        values: &Bound<'_, PyAny>,
    ) -> PyResult<()> {
        let range = Range::packed(&self.core, area, integer(address)?, values)?;
        py.detach(|| self.core.write(Access::Ingest, range.writing()))
            .map_err(|refusal| range.refused(&self.core, refusal))
    }

    /// Writes to several ranges (area, address, values) in one step.
    ///
    /// Where two overlap, the later one wins. Raises the errors of `write`; an error in one write
    /// prevents all.
    fn write_many(
        &self,
        py: Python<'_>,
        writes: Vec<(String, Bound<'_, PyAny>, Bound<'_, PyAny>)>,
    ) -> PyResult<()> {
        let ranges = writes.iter().map(|(area, address, values)| {
            Range::packed(&self.core, area, integer(address)?, values)
        });
        let ranges = ranges.collect::<PyResult<Vec<Range>>>()?;
        py.detach(|| {
            let writes: Vec<Write> = ranges.iter().map(Range::writing).collect();
            self.core.write_many(Access::Ingest, &writes)
        })
        .map_err(|refused| ranges[refused.index].refused(&self.core, refused.refusal))
    }

    /// Calls `callback(area, address, values)` after every write to this memory.
    ///
    /// The area of records is `file:NUMBER`, as in `write`.
    ///
    /// Writes are those of Modbus clients and of everything else, also of this program; with
    /// `clients_only`, only those of Modbus clients. A write that changes no value is one too, and
    /// a write of several ranges is several calls. The calls are in the order of the writes, on one
    /// thread of their own, and hold up neither the memory nor a client. If the callback is slower
    /// than the writes, the oldest are dropped and counted.
    ///
    /// An exception of the callback goes to `threading.excepthook`; the next call follows. A
    /// callback that writes to the same memory is called for that write as well, unless
    /// `clients_only` is set. Close the result to end the calls; they also end with the program.
    #[pyo3(signature = (callback, *, clients_only=false))]
    fn on_write<'py>(
        &self,
        py: Python<'py>,
        callback: &Bound<'py, PyAny>,
        clients_only: bool,
    ) -> PyResult<Bound<'py, PyAny>> {
        if !callback.is_callable() {
            let message = format!("callback is {}, allowed: a function", callback.repr()?);
            return Err(PyTypeError::new_err(message));
        }
        let queue = WriteQueue { core: py.detach(|| self.core.observe(clients_only)) };
        py.import("holdfast.server.write_callback")?
            .getattr("WriteCallback")?
            .call1((queue, callback))
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        let areas = self.areas(py)?;
        let areas = areas.iter().map(|(name, range)| format!("{name}={range}"));
        let files = self.files();
        let files = files.iter().map(|(number, records)| format!("file:{number}={records}"));
        Ok(format!("<Memory {}>", areas.chain(files).collect::<Vec<_>>().join(" ")))
    }
}

/// A range of an area, and its bytes.
pub(crate) struct Range {
    pub(crate) area: Area,
    pub(crate) address: u16,
    pub(crate) count: usize,
    bytes: Vec<u8>,
}

impl Range {
    /// A range to read. Its bytes are 0 until then.
    pub(crate) fn new(memory: &Core, area: &str, address: i128, count: i128) -> PyResult<Range> {
        let area = area_or_file(area)?;
        if count < 1 {
            return Err(PyValueError::new_err(format!("count is {count}, at least 1 is allowed")));
        }
        let inside = u16::try_from(address).ok().zip(usize::try_from(count).ok());
        let (address, count) = inside
            .filter(|(_, count)| *count <= Span::MAX_SIZE as usize)
            .ok_or_else(|| out_of_range(memory, area, address, count))?;
        Ok(Range { area, address, count, bytes: vec![0; area.byte_len(count)] })
    }

    /// A range to write, with `values` packed into bytes.
    fn packed(
        memory: &Core,
        area: &str,
        address: i128,
        values: &Bound<'_, PyAny>,
    ) -> PyResult<Range> {
        let items = numbers("values", area_or_file(area)?, values)?;
        let mut range =
            Range::new(memory, area, address, items.len() as i128).map_err(|error| {
                if items.is_empty() { PyValueError::new_err("values are empty") } else { error }
            })?;
        for (index, item) in items.into_iter().enumerate() {
            put(range.area, &mut range.bytes, index, item);
        }
        Ok(range)
    }

    fn reading(&mut self) -> Read<'_> {
        Read { area: self.area, address: self.address, count: self.count, out: &mut self.bytes }
    }

    fn writing(&self) -> Write<'_> {
        Write { area: self.area, address: self.address, count: self.count, bytes: &self.bytes }
    }

    fn values<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
        listed(py, self.area, self.count, &self.bytes)
    }

    pub(crate) fn refused(&self, memory: &Core, refusal: Refusal) -> PyErr {
        match refusal {
            Refusal::OutOfRange => {
                out_of_range(memory, self.area, i128::from(self.address), self.count as i128)
            }
            stale @ Refusal::Stale => Stale::new_err(stale.to_string()),
            journal @ (Refusal::Unavailable
            | Refusal::Busy
            | Refusal::TooLarge { .. }
            | Refusal::NotStored
            | Refusal::NotConfirmed
            | Refusal::Overtaken
            | Refusal::Behind
            | Refusal::Differs) => PyOSError::new_err(journal.to_string()),
            other => PyValueError::new_err(other.to_string()),
        }
    }
}

pub fn named(area: &str) -> PyResult<Area> {
    Area::from_name(area).ok_or_else(|| {
        let known = Area::ALL.map(Area::name).join(", ");
        PyValueError::new_err(format!("unknown area {area:?}, allowed: {known}"))
    })
}

fn area_or_file(name: &str) -> PyResult<Area> {
    Area::file_from_name(name).map_or_else(|| named(name), Ok)
}

fn gate(seal: Seal) -> PyResult<Gate> {
    let (area, address, mode) = match seal {
        Seal::Once(area, address) => (area, address, GateMode::Once),
        Seal::Mode(area, address, mode) => {
            let modes = [("once", GateMode::Once), ("level", GateMode::Level)];
            (area, address, word("mode of seal", &mode, &modes)?)
        }
    };
    let address = within("address of seal", address.0, 0..=65_535)? as u16;
    Ok(Gate { area: named(&area)?, address, mode })
}

fn out_of_range(memory: &Core, area: Area, address: i128, count: i128) -> PyErr {
    let span = memory.span(area);
    let name = area.name();
    let found = format!("{count} from address {address}");
    OutOfRange::new_err(match span.size() {
        0 => format!("{name}: {found}, but this memory has no {name}"),
        _ => {
            let last = span.end() - 1;
            format!("{name}: {found}, allowed: addresses {} to {last}", span.start())
        }
    })
}

/// A Python integer. An integer beyond 128 bits is clamped: the result is still out of range for
/// every address, count and value.
pub fn integer(value: &Bound<'_, PyAny>) -> PyResult<i128> {
    // With Python's stable ABI, extracting an `i128` takes ten times as long as an `i64`, and an
    // object that only has `__index__` can't become one.
    if let Ok(number) = value.extract::<i64>() {
        return Ok(number.into());
    }
    match value.extract::<i128>() {
        Err(error) if error.is_instance_of::<PyOverflowError>(value.py()) => {
            Ok(if value.lt(0)? { i128::MIN } else { i128::MAX })
        }
        extracted => extracted,
    }
}

/// The extent of an area: a size from address 0, or a start and a size.
fn start_and_size(area: &str, extent: &Bound<'_, PyAny>) -> PyResult<(i128, i128)> {
    let found = match extent.extract::<(Integer, Integer)>() {
        Ok((start, size)) => Ok((start.0, size.0)),
        Err(_) => integer(extent).map(|size| (0, size)),
    };
    found.or_else(|_| {
        let allowed = "an integer, or (start, size)";
        let text = format!("size of {area} is {}, allowed: {allowed}", extent.repr()?);
        Err(PyTypeError::new_err(text))
    })
}

/// An argument that is an [`integer`].
#[derive(Clone, Copy)]
pub struct Integer(pub i128);

impl<'py> FromPyObject<'_, 'py> for Integer {
    type Error = PyErr;

    fn extract(value: Borrowed<'_, 'py, PyAny>) -> PyResult<Integer> {
        integer(&value).map(Integer)
    }
}

/// Puts an item into the bytes of a range, whose bits are 0 so far.
pub fn put(area: Area, bytes: &mut [u8], index: usize, item: u16) {
    if area.is_bits() {
        bytes[index / 8] |= (item as u8) << (index % 8);
    } else {
        bytes[index * 2..index * 2 + 2].copy_from_slice(&item.to_be_bytes());
    }
}

/// Extracts and checks the integers of a Python iterable, which errors name.
pub fn numbers<'py>(name: &str, area: Area, values: &Bound<'py, PyAny>) -> PyResult<Vec<u16>> {
    let number = |(index, value): (usize, Bound<'py, PyAny>)| {
        item(area, &value)
            .or_else(|unfit| Err(unfit.error(area, &format!("{name}[{index}]"), &value)?))
    };
    if let Ok(list) = values.cast_exact::<PyList>() {
        return list.iter().enumerate().map(number).collect();
    }
    if !is_sequence(values) || (!area.is_bits() && is_view_of_bytes(values)) {
        let found = values.get_type().name()?;
        let message = format!("{name} are {found}, not a sequence of integers");
        return Err(PyTypeError::new_err(message));
    }
    let mut numbers = Vec::with_capacity(values.len().unwrap_or(0).min(Span::MAX_SIZE as usize));
    for (index, value) in values.try_iter()?.enumerate() {
        numbers.push(number((index, value?))?);
    }
    Ok(numbers)
}

/// Whether what an iterable yields are values, in an order.
///
/// Text and bytes yield characters, a mapping its keys, a set no order, and what has rows and columns,
/// such as a `DataFrame` of pandas, the names of its columns.
pub fn is_sequence(values: &Bound<'_, PyAny>) -> bool {
    let is_text = values.is_instance_of::<PyString>()
        || values.is_instance_of::<PyBytes>()
        || values.is_instance_of::<PyByteArray>();
    // The usual ones, at once: what follows takes longer than a write of one register.
    let may_have_rows = values.is_instance_of::<PyMemoryView>();
    if !is_text && !may_have_rows && values.cast::<PySequence>().is_ok() {
        return true;
    }
    let is_unordered = values.is_instance_of::<PySet>()
        || values.is_instance_of::<PyFrozenSet>()
        || values.cast::<PyMapping>().is_ok();
    let dimensions = values.getattr("ndim").and_then(|dimensions| dimensions.extract::<usize>());
    !is_text && !is_unordered && dimensions.unwrap_or(1) == 1
}

/// Whether this is a view of bytes: each would become a register. As bits, its items may be 0 and 1.
fn is_view_of_bytes(values: &Bound<'_, PyAny>) -> bool {
    let format = values.cast::<PyMemoryView>().ok().and_then(|view| view.getattr("format").ok());
    let format = format.and_then(|format| format.extract::<String>().ok());
    // As ctypes has it, `<B`.
    format.is_some_and(|format| matches!(format.trim_start_matches('<'), "B" | "c"))
}

/// Why an object is not a value of an area.
pub enum Unfit {
    /// The integer is too small or too large.
    Value,
    /// The object is not an integer, or is a boolean for a register.
    Type,
}

impl Unfit {
    /// The error for a value of an area.
    pub fn error(self, area: Area, name: &str, value: &Bound<'_, PyAny>) -> PyResult<PyErr> {
        let allowed = if area.is_bits() { "0, 1, False, True" } else { "integers 0 to 65535" };
        let shown = value.py().import("reprlib")?.call_method1("repr", (value,))?;
        let message = format!("{name} is {shown}, allowed: {allowed}");
        Ok(match self {
            Unfit::Value => PyValueError::new_err(message),
            Unfit::Type => PyTypeError::new_err(message),
        })
    }
}

/// The largest value of an area.
pub const fn largest(area: Area) -> u16 {
    if area.is_bits() { 1 } else { u16::MAX }
}

/// Extracts and checks one value of an area.
pub fn item(area: Area, value: &Bound<'_, PyAny>) -> Result<u16, Unfit> {
    let most = largest(area);
    if let Ok(integer) = value.cast_exact::<PyInt>()
        && let Ok(number) = integer.extract::<u16>()
        && number <= most
    {
        return Ok(number);
    }
    if value.is_instance_of::<PyBool>() || is_numpy_bool(value) {
        let bit = value.is_truthy().map_err(|_| Unfit::Type)?;
        return if area.is_bits() { Ok(bit.into()) } else { Err(Unfit::Type) };
    }
    let number = integer(value).map_err(|_| Unfit::Type)?;
    u16::try_from(number).ok().filter(|number| *number <= most).ok_or(Unfit::Value)
}

/// Whether this is a boolean of NumPy, which is not a `bool`, and in old versions an integer.
fn is_numpy_bool(value: &Bound<'_, PyAny>) -> bool {
    let kind = value.get_type();
    let is = |name: PyResult<Bound<'_, PyString>>, allowed: &[&str]| {
        name.is_ok_and(|name| allowed.iter().any(|allowed| name == *allowed))
    };
    is(kind.name(), &["bool", "bool_"]) && is(kind.module(), &["numpy"])
}
