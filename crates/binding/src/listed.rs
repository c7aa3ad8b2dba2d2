//! The bytes of a memory as a Python list.

use holdfast_memory::Area;
use pyo3::prelude::*;
use pyo3::types::PyList;

/// The values of `count` items of an area.
pub fn listed<'py>(
    py: Python<'py>,
    area: Area,
    count: usize,
    bytes: &[u8],
) -> PyResult<Bound<'py, PyList>> {
    if area.is_bits() {
        PyList::new(py, (0..count).map(|index| bytes[index / 8] >> (index % 8) & 1))
    } else {
        let registers = bytes.chunks_exact(2);
        PyList::new(py, registers.map(|pair| u16::from_be_bytes([pair[0], pair[1]])))
    }
}
