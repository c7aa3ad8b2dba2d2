//! `Heads`: what is known about heads of requests that came before.

use std::collections::HashMap;
use std::hash::{BuildHasher, RandomState};
use std::sync::Mutex;

use holdfast_engine::http::{CONTENT_LENGTH, Parts, Version};
use holdfast_runtime::lock;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyList, PyTuple};

/// The most heads that are remembered, and the longest in bytes.
const MAX_HEADS: usize = 64;
const MAX_HEAD_BYTES: usize = 2048;

/// Heads of requests. Clients send the same head again and again, so requests with the same head get the
/// same object, and handlers can keep in it what they have found out about the head.
///
/// Heads have secrets. They are compared only if their hashes are equal, whose key nobody knows, so the
/// time that it takes does not tell how much of a head is right.
#[derive(Default)]
pub struct Heads {
    known: Mutex<HashMap<u64, Head>>,
    hasher: RandomState,
}

struct Head {
    bytes: Vec<u8>,
    /// Method, path, query, version, headers and `kept`.
    parts: Py<PyTuple>,
    /// What handlers keep.
    kept: Py<PyDict>,
}

impl Heads {
    pub fn of<'py>(
        &self,
        py: Python<'py>,
        parts: &Parts,
    ) -> PyResult<(Bound<'py, PyTuple>, Bound<'py, PyDict>)> {
        let bytes = bytes_of(parts);
        let hash = self.hasher.hash_one(&bytes);
        if let Some(head) = lock(&self.known).get(&hash)
            && head.bytes == bytes
        {
            return Ok((head.parts.bind(py).clone(), head.kept.bind(py).clone()));
        }
        let kept = PyDict::new(py);
        let parts = head_to_python(py, parts, &kept)?;
        if bytes.len() <= MAX_HEAD_BYTES {
            let mut known = lock(&self.known);
            if known.len() == MAX_HEADS {
                // Those of which nothing is kept are refused requests: anybody can send them.
                known.retain(|_, head| !head.kept.bind(py).is_empty());
            }
            if known.len() == MAX_HEADS {
                known.clear();
            }
            let (parts, kept) = (parts.clone().unbind(), kept.clone().unbind());
            known.insert(hash, Head { bytes, parts, kept });
        }
        Ok((parts, kept))
    }
}

fn head_to_python<'py>(
    py: Python<'py>,
    parts: &Parts,
    kept: &Bound<'py, PyDict>,
) -> PyResult<Bound<'py, PyTuple>> {
    let headers = PyList::empty(py);
    for (name, value) in headers_of(parts) {
        headers.append((PyBytes::new(py, name), PyBytes::new(py, value)))?;
    }
    let query = PyBytes::new(py, query_of(parts).as_bytes());
    (parts.method.as_str(), parts.uri.path(), query, version_of(parts), headers, kept)
        .into_pyobject(py)
}

/// All that distinguishes a head from others. None of its parts has a line feed.
fn bytes_of(parts: &Parts) -> Vec<u8> {
    let line = [version_of(parts), parts.method.as_str(), parts.uri.path(), query_of(parts)];
    let mut bytes = line.join("\n").into_bytes();
    for (name, value) in headers_of(parts) {
        for part in [b"\n", name, b":", value] {
            bytes.extend_from_slice(part);
        }
    }
    bytes
}

fn version_of(parts: &Parts) -> &'static str {
    if parts.version == Version::HTTP_10 { "1.0" } else { "1.1" }
}

fn query_of(parts: &Parts) -> &str {
    parts.uri.query().unwrap_or_default()
}

/// Without the length of the body, which differs between requests of one kind.
fn headers_of(parts: &Parts) -> impl Iterator<Item = (&[u8], &[u8])> {
    let others = parts.headers.iter().filter(|(name, _)| *name != CONTENT_LENGTH);
    others.map(|(name, value)| (name.as_str().as_bytes(), value.as_bytes()))
}
