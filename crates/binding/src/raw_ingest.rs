//! Encodes Raw Ingest packets: values into a payload, a payload into a packet.

use std::num::NonZeroU16;

use holdfast_engine::raw_ingest_areas::in_packet;
use holdfast_protocol::raw_ingest::Header;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::arguments::packet_format;
use crate::memory::{named, numbers, put};

/// Packs bits or registers into a payload. Returns it with their number. Values must be integers;
/// booleans are allowed for bits only.
#[pyfunction]
pub fn pack_raw_ingest<'py>(
    py: Python<'py>,
    area: &str,
    values: &Bound<'py, PyAny>,
) -> PyResult<(Bound<'py, PyBytes>, usize)> {
    let area = named(area)?;
    let items = numbers("values", area, values)?;
    let mut payload = vec![0; area.byte_len(items.len())];
    for (index, item) in items.iter().enumerate() {
        put(area, &mut payload, index, *item);
    }
    Ok((PyBytes::new(py, &payload), items.len()))
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
