//! The bytes of a memory as values, and as a Python list.

use holdfast_memory::Area;
use pyo3::prelude::*;
use pyo3::types::PyList;

/// The values of `count` items of an area.
pub fn items(area: Area, count: usize, bytes: &[u8]) -> impl ExactSizeIterator<Item = u16> + '_ {
    (0..count).map(move |index| {
        if area.is_bits() {
            u16::from(bytes[index / 8] >> (index % 8) & 1)
        } else {
            u16::from_be_bytes([bytes[index * 2], bytes[index * 2 + 1]])
        }
    })
}

/// The values of `count` items of an area.
pub fn listed<'py>(
    py: Python<'py>,
    area: Area,
    count: usize,
    bytes: &[u8],
) -> PyResult<Bound<'py, PyList>> {
    PyList::new(py, items(area, count, bytes))
}
