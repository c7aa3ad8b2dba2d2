//! Encodes Raw Ingest packets: values into a payload, a payload into a packet.

use std::num::NonZeroU16;

use holdfast_engine::raw_ingest_areas::in_packet;
use holdfast_protocol::raw_ingest::Header;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyList};

use crate::arguments::packet_format;
use crate::memory::{named, number, put};

/// Packs bits or registers into a payload. Values must be integers; booleans are allowed for bits
/// only.
#[pyfunction]
pub fn pack_raw_ingest<'py>(
    py: Python<'py>,
    area: &str,
    values: &Bound<'py, PyList>,
) -> PyResult<Bound<'py, PyBytes>> {
    let area = named(area)?;
    let count = values.len();
    let mut payload = vec![0; area.byte_len(count)];
    // The list may grow meanwhile.
    for (index, value) in values.iter().enumerate().take(count) {
        let short =
            |value: &Bound<'py, PyAny>| py.import("reprlib")?.call_method1("repr", (value,));
        put(area, &mut payload, index, number(area, index, &value, short)?);
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
    let format = packet_format(format, crc)?;
    let area = in_packet(named(area)?).expect("it is one of the four areas");
    let count = NonZeroU16::new(count).ok_or_else(|| PyValueError::new_err("count is 0"))?;
    let header = Header { area, target, address, count };
    PyBytes::new_with(py, format.packet_len(&header), |packet| {
        let encoded = format.encode_to_slice(&header, payload, packet);
        encoded.map(drop).map_err(|error| PyValueError::new_err(error.to_string()))
    })
}
