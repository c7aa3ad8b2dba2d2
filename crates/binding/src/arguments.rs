//! Checks arguments from Python. Each error says what was found and what is allowed.

use std::io;
use std::net::{IpAddr, SocketAddr};
use std::ops::RangeInclusive;
use std::time::Duration;

use holdfast_protocol::raw_ingest::Format;
use ipnet::IpNet;
use pyo3::exceptions::{PyOSError, PyValueError};
use pyo3::prelude::*;

/// Checks that an integer is in a range.
pub fn within(what: &str, found: i128, allowed: RangeInclusive<usize>) -> PyResult<usize> {
    usize::try_from(found).ok().filter(|number| allowed.contains(number)).ok_or_else(|| {
        let (least, most) = (allowed.start(), allowed.end());
        PyValueError::new_err(format!("{what} is {found}, allowed: {least} to {most}"))
    })
}

pub fn byte(what: &str, found: i128) -> PyResult<u8> {
    Ok(within(what, found, 0..=255)? as u8)
}

pub fn unknown(what: &str, found: &str, allowed: &str) -> PyErr {
    PyValueError::new_err(format!("{what} is {found:?}, allowed: {allowed}"))
}

/// Parses a network or a single address.
pub fn network(text: &str) -> PyResult<IpNet> {
    let network = text.parse::<IpNet>().ok();
    network.or_else(|| text.parse::<IpAddr>().ok().map(IpNet::from)).ok_or_else(|| {
        unknown("source", text, "addresses and networks as in 10.0.0.0/8 or fd00::/64")
    })
}

pub fn seconds(what: &str, seconds: f64) -> PyResult<Duration> {
    Duration::try_from_secs_f64(seconds)
        .ok()
        .filter(|duration| duration.as_secs() <= 366 * 24 * 3600)
        .ok_or_else(|| unknown(what, &seconds.to_string(), "0 to 31622400 seconds"))
}

pub fn time_to_wait(what: &str, time: f64) -> PyResult<Duration> {
    let time = seconds(what, time)?;
    if time.is_zero() {
        return Err(PyValueError::new_err(format!("{what} is 0, it must be more than 0")));
    }
    Ok(time)
}

/// Parses IP addresses, to their canonical form.
pub fn ip_addresses(what: &str, texts: &[String]) -> PyResult<Vec<IpAddr>> {
    let parsed = texts.iter().map(|text| match text.parse::<IpAddr>() {
        Ok(address) => Ok(address.to_canonical()),
        Err(_) => Err(unknown(what, text, "IP addresses")),
    });
    parsed.collect()
}

pub fn address(text: &str) -> PyResult<SocketAddr> {
    let form = "address:port as in 127.0.0.1:502 or [::1]:502";
    text.parse().map_err(|_| unknown("bind", text, form))
}

/// An `OSError`, with the number of the error if it has one: Python selects the subclass by that.
pub fn os_error(error: &io::Error, text: String) -> PyErr {
    match error.raw_os_error() {
        Some(number) => PyOSError::new_err((number, text)),
        None => PyOSError::new_err(text),
    }
}

/// The text of an error without its number, which an `OSError` has itself.
pub fn os_text(error: &io::Error) -> String {
    let text = error.to_string();
    text.split(" (os error").next().unwrap_or(&text).to_owned()
}

/// The format of Raw Ingest packets.
pub fn packet_format(format: &str, crc: &str) -> PyResult<Format> {
    let required = word("crc", crc, &[("required", true), ("none", false)])?;
    word("format", format, &[("v1", Format::V1), ("crc", Format::Crc { required })])
}

/// Looks up a word in a list of allowed words and their values.
pub fn word<T: Copy>(what: &str, found: &str, allowed: &[(&str, T)]) -> PyResult<T> {
    let named = allowed.iter().find(|(name, _)| *name == found);
    named.map(|(_, value)| *value).ok_or_else(|| {
        let names: Vec<&str> = allowed.iter().map(|(name, _)| *name).collect();
        unknown(what, found, &names.join(", "))
    })
}
