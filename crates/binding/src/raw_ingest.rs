//! Encodes Raw Ingest packets: values into a payload, a payload into a packet.

use std::num::NonZeroU16;

use holdfast_engine::packet_area::in_packet;
use holdfast_memory::Area;
use holdfast_protocol::raw_ingest::{Format, Header};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyList};

use crate::arguments::word;
use crate::memory::{self, Unfit, named};

/// Packs bits or registers into a payload. Values must be integers; booleans are allowed for bits
/// only.
#[pyfunction]
pub fn pack_raw_ingest<'py>(
    py: Python<'py>,
    area: &str,
    values: &Bound<'py, PyList>,
) -> PyResult<Bound<'py, PyBytes>> {
    let area = named(area)?;
    let mut payload = vec![0; area.byte_len(values.len())];
    if area.is_bits() {
        for (index, value) in values.iter().enumerate() {
            let bit = item(area, index, &value)? as u8;
            if let Some(byte) = payload.get_mut(index / 8) {
                *byte |= bit << (index % 8);
            }
        }
    } else {
        for ((index, value), pair) in values.iter().enumerate().zip(payload.chunks_exact_mut(2)) {
            pair.copy_from_slice(&item(area, index, &value)?.to_be_bytes());
        }
    }
    Ok(PyBytes::new(py, &payload))
}

/// Encodes one packet. `target` is a unit id (v1) or a memory id (crc).
#[pyfunction]
#[pyo3(signature = (payload, *, area, address, count, target, format, crc))]
#[allow(clippy::too_many_arguments, reason = "they are keywords in Python")]
pub fn encode_raw_ingest<'py>(
    py: Python<'py>,
    payload: &[u8],
    area: &str,
    address: u16,
    count: u16,
    target: u16,
    format: &str,
    crc: &str,
) -> PyResult<Bound<'py, PyBytes>> {
    let required = word("crc", crc, &[("required", true), ("none", false)])?;
    let formats = [("v1", Format::V1), ("crc", Format::Crc { required })];
    let format = word("format", format, &formats)?;
    let area = in_packet(named(area)?);
    let count = NonZeroU16::new(count).ok_or_else(|| PyValueError::new_err("count is 0"))?;
    let header = Header { area, target, address, count };
    PyBytes::new_with(py, format.packet_len(&header), |packet| {
        let encoded = format.encode_to_slice(&header, payload, packet);
        encoded.map(drop).map_err(|error| PyValueError::new_err(error.to_string()))
    })
}

fn item(area: Area, index: usize, value: &Bound<'_, PyAny>) -> PyResult<u16> {
    memory::item(area, value).or_else(|unfit| {
        let allowed = if area.is_bits() { "0, 1, False, True" } else { "integers 0 to 65535" };
        let shown = value.py().import("reprlib")?.call_method1("repr", (value,))?;
        let message = format!("values[{index}] is {shown}, allowed: {allowed}");
        Err(match unfit {
            Unfit::Value => PyValueError::new_err(message),
            Unfit::Type => PyTypeError::new_err(message),
        })
    })
}
