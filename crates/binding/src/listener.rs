//! `Rule`, `RawRule` and `Listener`: settings of listeners.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use holdfast_engine::items::Items;
use holdfast_engine::server::functions::{AccessMode, Functions};
use holdfast_engine::server::policy::{Elsewhere, Narrowed, Rule as CoreRule};
use holdfast_engine::server::ranges::Ranges;
use holdfast_engine::server::{
    AfterRefusal, ConnectionLimits, DatagramFraming, Flags, ListenerKind, ListenerSettings,
    PacketsPerConnection, RawRule as CoreRawRule, RawSettings, SerialSettings, StreamFraming,
    StreamSettings, UdpSettings, WhenFull,
};
use holdfast_memory::Memory as CoreMemory;
use holdfast_protocol::raw_ingest::Format;
use ipnet::IpNet;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyMapping;

use crate::arguments::{address, byte, network, seconds, time_to_wait, within, word};
use crate::client::line;
use crate::link::{Passage, Route};
use crate::memory::{Memory, named};
use crate::server_tls::ServerTls;

/// The access of rules.
const ACCESS: [(&str, AccessMode); 2] =
    [("read-only", AccessMode::ReadOnly), ("read-write", AccessMode::ReadWrite)];

/// Area, first address, how many items.
type Range = (String, u16, u32);

/// What may be read, and what may be written; `None` is everything.
type Limits = (Option<Vec<Range>>, Option<Vec<Range>>);

/// The rights of a unit: access, functions, denied functions, ranges.
type Narrow = (String, Option<Vec<i128>>, Option<Vec<i128>>, Limits);

/// What the peers of some networks may do.
///
/// `units` maps unit ids, 0 to 255, to memories, routes and passages. `sources` are networks or
/// addresses, IPv4 or IPv6; an IPv4-mapped IPv6 address counts as its IPv4 address. Set
/// `functions`, the allowed function codes, or `deny`, the codes that are not allowed, but not
/// both. `roles`, only with TLS, are the allowed roles of the peer's certificate: "" is a
/// certificate without a role, `None` is any role. `narrowed` are units with rights of their own:
/// access, functions, denied functions, and the ranges that they may read and write, each an area,
/// its first address and a count; `None` is everything.
///
/// Raises `ValueError` for an invalid source or access.
#[pyclass(frozen, module = "holdfast")]
pub struct Rule {
    core: CoreRule,
}

#[pymethods]
impl Rule {
    #[new]
    #[pyo3(signature = (units, *, sources, access, functions=None, deny=None, roles=None, narrowed=None))]
    fn new(
        units: &Bound<'_, PyMapping>,
        sources: Vec<String>,
        access: &str,
        functions: Option<Vec<i128>>,
        deny: Option<Vec<i128>>,
        roles: Option<Vec<String>>,
        narrowed: Option<BTreeMap<i128, Narrow>>,
    ) -> PyResult<Rule> {
        let access = word("access", access, &ACCESS)?;
        let functions = self::functions(functions, deny)?;
        let narrowed = narrowed.unwrap_or_default().into_iter().map(|(unit, own)| {
            let (access, functions, deny, (read, write)) = own;
            let narrowed = Narrowed {
                access: word("access", &access, &ACCESS)?,
                functions: self::functions(functions, deny)?,
                ranges: Ranges::new(ranges(read)?, ranges(write)?),
            };
            Ok((byte("unit id", unit)?, narrowed))
        });
        let narrowed = narrowed.collect::<PyResult<_>>()?;
        let (mut memories, mut elsewhere) = (Vec::new(), Vec::new());
        for item in units.items()?.iter() {
            let (unit, target): (i128, Bound<'_, PyAny>) = item.extract()?;
            let unit = byte("unit id", unit)?;
            if let Ok(route) = target.extract::<PyRef<'_, Route>>() {
                elsewhere.push((unit, Elsewhere::Device(route.core.clone())));
            } else if let Ok(passage) = target.extract::<PyRef<'_, Passage>>() {
                memories.push((unit, Arc::clone(&passage.core.memory)));
                elsewhere.push((unit, Elsewhere::Mirror(Arc::clone(&passage.core))));
            } else {
                let memory: PyRef<'_, Memory> = target.extract()?;
                memories.push((unit, Arc::clone(&memory.core)));
            }
        }
        let (sources, units) = (networks(&sources)?, memories);
        Ok(Rule {
            core: CoreRule { sources, roles, units, elsewhere, access, functions, narrowed },
        })
    }
}

#[pyclass(frozen, module = "holdfast")]
pub struct RawRule {
    core: CoreRawRule,
}

#[pymethods]
impl RawRule {
    #[new]
    #[pyo3(signature = (targets, *, sources, areas, roles=None))]
    fn new(
        targets: &Bound<'_, PyMapping>,
        sources: Vec<String>,
        areas: Vec<String>,
        roles: Option<Vec<String>>,
    ) -> PyResult<RawRule> {
        let targets = self::targets(targets)?.into_iter().map(|(target, memory)| {
            Ok((within("unit or memory id", target, 0..=65_535)? as u16, memory))
        });
        let targets = targets.collect::<PyResult<_>>()?;
        let areas = areas.iter().map(|area| named(area)).collect::<PyResult<_>>()?;
        Ok(RawRule { core: CoreRawRule { sources: networks(&sources)?, roles, targets, areas } })
    }
}

#[pyclass(frozen, module = "holdfast")]
pub struct Listener {
    pub core: ListenerSettings,
}

#[pymethods]
#[allow(clippy::too_many_arguments, reason = "they are keywords in Python")]
impl Listener {
    #[new]
    #[pyo3(signature = (name, bind, rules, *, framing="mbap", max_connections=256, max_connections_per_source=None, when_full="refuse", idle_timeout=300.0, request_timeout=10.0, frame_timeout=None, listen_only=false, tls=None, max_handshakes=256, raw_ingest=None))]
    fn new(
        name: String,
        bind: &str,
        rules: Vec<PyRef<'_, Rule>>,
        framing: &str,
        max_connections: i128,
        max_connections_per_source: Option<i128>,
        when_full: &str,
        idle_timeout: f64,
        request_timeout: f64,
        frame_timeout: Option<f64>,
        listen_only: bool,
        tls: Option<PyRef<'_, ServerTls>>,
        max_handshakes: i128,
        raw_ingest: Option<PyRef<'_, Listener>>,
    ) -> PyResult<Listener> {
        let raw_ingest = match raw_ingest.map(|listener| listener.core.kind.clone()) {
            None => None,
            Some(ListenerKind::RawIngest(settings))
                if framing == "mbap" && tls.is_none() && settings.tls.is_none() =>
            {
                Some(settings)
            }
            Some(_) => {
                let message =
                    "raw_ingest takes a Raw Ingest listener, with framing mbap and no tls";
                return Err(PyValueError::new_err(message));
            }
        };
        let idle_timeout = seconds("idle_timeout", idle_timeout)?;
        let limits = limits(max_connections, max_connections_per_source, when_full)?;
        let framings = [
            ("mbap", StreamFraming::Mbap),
            ("rtu", StreamFraming::Rtu),
            ("ascii", StreamFraming::Ascii),
        ];
        let kind = ListenerKind::ModbusStream(StreamSettings {
            bind: address(bind)?,
            framing: word("framing", framing, &framings)?,
            rules: cores(&rules),
            limits: secure_limits(limits, tls.is_some(), max_handshakes)?,
            idle_timeout: (!idle_timeout.is_zero()).then_some(idle_timeout),
            request_timeout: time_to_wait("request_timeout", request_timeout)?,
            frame_timeout: frame_timeout
                .map(|time| time_to_wait("frame_timeout", time))
                .transpose()?,
            listen_only,
            tls: tls.map(|tls| tls.of_listener()).transpose()?,
            raw_ingest,
        });
        Ok(Listener { core: ListenerSettings { name, kind } })
    }

    #[staticmethod]
    #[pyo3(signature = (name, bind, rules, *, framing="mbap", listen_only=false))]
    fn udp(
        name: String,
        bind: &str,
        rules: Vec<PyRef<'_, Rule>>,
        framing: &str,
        listen_only: bool,
    ) -> PyResult<Listener> {
        let framings = [("mbap", DatagramFraming::Mbap), ("rtu", DatagramFraming::Rtu)];
        let udp = UdpSettings {
            bind: address(bind)?,
            framing: word("framing", framing, &framings)?,
            rules: cores(&rules),
            listen_only,
        };
        Ok(Listener { core: ListenerSettings { name, kind: ListenerKind::ModbusUdp(udp) } })
    }

    #[staticmethod]
    #[pyo3(signature = (name, device, rule, *, mode, baud, parity, stop_bits, data_bits, silence=None, rs485=None))]
    fn serial(
        name: String,
        device: String,
        rule: PyRef<'_, Rule>,
        mode: &str,
        baud: i128,
        parity: &str,
        stop_bits: i128,
        data_bits: i128,
        silence: Option<f64>,
        rs485: Option<String>,
    ) -> PyResult<Listener> {
        let line = line(device, mode, baud, parity, stop_bits, data_bits, silence, rs485)?;
        let kind = ListenerKind::ModbusSerial(SerialSettings { line, rule: rule.core.clone() });
        Ok(Listener { core: ListenerSettings { name, kind } })
    }

    #[staticmethod]
    #[pyo3(signature = (name, bind, rules, *, format="v1", crc="required", flags="strict", max_connections=256, max_connections_per_source=None, when_full="refuse", request_timeout=10.0, packets="one", idle_timeout=300.0, after_refusal="close", tls=None, max_handshakes=256))]
    fn raw_ingest(
        name: String,
        bind: &str,
        rules: Vec<PyRef<'_, RawRule>>,
        format: &str,
        crc: &str,
        flags: &str,
        max_connections: i128,
        max_connections_per_source: Option<i128>,
        when_full: &str,
        request_timeout: f64,
        packets: &str,
        idle_timeout: f64,
        after_refusal: &str,
        tls: Option<PyRef<'_, ServerTls>>,
        max_handshakes: i128,
    ) -> PyResult<Listener> {
        let idle = time_to_wait("idle_timeout", idle_timeout)?;
        let refusals = [("close", AfterRefusal::Close), ("continue", AfterRefusal::Continue)];
        let after_refusal = word("after_refusal", after_refusal, &refusals)?;
        let many = PacketsPerConnection::Many { idle, after_refusal };
        let packets =
            word("packets", packets, &[("one", PacketsPerConnection::One), ("many", many)])?;
        let required = word("crc", crc, &[("required", true), ("none", false)])?;
        let formats = [("v1", Format::V1), ("crc", Format::Crc { required })];
        let limits = limits(max_connections, max_connections_per_source, when_full)?;
        let kind = ListenerKind::RawIngest(RawSettings {
            bind: address(bind)?,
            format: word("format", format, &formats)?,
            flags: word("flags", flags, &[("strict", Flags::Strict), ("ignore", Flags::Ignore)])?,
            rules: rules.iter().map(|rule| rule.core.clone()).collect(),
            limits: secure_limits(limits, tls.is_some(), max_handshakes)?,
            request_timeout: time_to_wait("request_timeout", request_timeout)?,
            packets,
            tls: tls.map(|tls| tls.of_listener()).transpose()?,
        });
        Ok(Listener { core: ListenerSettings { name, kind } })
    }
}

fn functions(only: Option<Vec<i128>>, deny: Option<Vec<i128>>) -> PyResult<Functions> {
    let codes = |codes: Option<Vec<i128>>| {
        let codes = codes.map(|codes| codes.into_iter().map(|code| byte("function code", code)));
        codes.map(Iterator::collect::<PyResult<Vec<u8>>>).transpose()
    };
    match (codes(only)?, codes(deny)?) {
        (None, None) => Ok(Functions::All),
        (Some(codes), None) => Ok(Functions::Only(codes)),
        (None, Some(codes)) => Ok(Functions::Except(codes)),
        (Some(_), Some(_)) => {
            Err(PyValueError::new_err("functions and deny: give one of them, or neither"))
        }
    }
}

fn ranges(given: Option<Vec<Range>>) -> PyResult<Option<Vec<Items>>> {
    let items = |(area, address, count): Range| Ok(Items { area: named(&area)?, address, count });
    given.map(|given| given.into_iter().map(items).collect()).transpose()
}

fn cores(rules: &[PyRef<'_, Rule>]) -> Vec<CoreRule> {
    rules.iter().map(|rule| rule.core.clone()).collect()
}

fn networks(sources: &[String]) -> PyResult<Vec<IpNet>> {
    sources.iter().map(|text| network(text)).collect()
}

/// Converts a mapping from ids to memories.
fn targets(mapping: &Bound<'_, PyMapping>) -> PyResult<Vec<(i128, Arc<CoreMemory>)>> {
    let mut targets = Vec::new();
    for item in mapping.items()?.iter() {
        let (id, memory): (i128, PyRef<'_, Memory>) = item.extract()?;
        targets.push((id, Arc::clone(&memory.core)));
    }
    Ok(targets)
}

pub(crate) fn limits(
    max_connections: i128,
    max_connections_per_source: Option<i128>,
    when_full: &str,
) -> PyResult<ConnectionLimits> {
    let allowed = [("refuse", WhenFull::Refuse), ("evict", WhenFull::Evict)];
    let of_source = max_connections_per_source
        .map(|most| within("max_connections_per_source", most, 1..=65_535))
        .transpose()?;
    Ok(ConnectionLimits {
        max_connections: within("max_connections", max_connections, 1..=65_535)?,
        max_connections_per_source: of_source,
        when_full: word("when_full", when_full, &allowed)?,
        max_handshakes: None,
        grace: Duration::ZERO,
    })
}

/// The limits of a listener that may have TLS.
fn secure_limits(
    limits: ConnectionLimits,
    has_tls: bool,
    max_handshakes: i128,
) -> PyResult<ConnectionLimits> {
    let most = within("max_handshakes", max_handshakes, 1..=65_535)?;
    Ok(ConnectionLimits { max_handshakes: has_tls.then_some(most), ..limits })
}
