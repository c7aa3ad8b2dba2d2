//! `Rule`, `RawRule` and `Listener`: settings of listeners.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use holdfast_engine::items::Items;
use holdfast_engine::server::requests::unit_server::UnitSettings;
use holdfast_engine::server::rights::functions::{AccessMode, Functions};
use holdfast_engine::server::rights::ranges::Ranges;
use holdfast_engine::server::rights::rule::{Narrowed, RequestDestination, Rule as CoreRule};
use holdfast_engine::server::{
    AfterRefusal, ConnectionLimits, DatagramFraming, Flags, ListenerKind, ListenerSettings,
    PacketsPerConnection, RawRule as CoreRawRule, RawSettings, SerialSettings, StreamFraming,
    StreamSettings, UdpSettings, WhenFull,
};
use holdfast_engine::tls::server::Protocol;
use holdfast_memory::Area;
use ipnet::IpNet;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyMapping;

use crate::arguments::{
    address, byte, network, packet_format, seconds, time_to_wait, within, word,
};
use crate::client::line;
use crate::link::{Passage, Route};
use crate::memory::{Memory, named};
use crate::server_tls::ServerTls;

/// The access of rules.
const ACCESS: [(&str, AccessMode); 2] =
    [("read-only", AccessMode::ReadOnly), ("read-write", AccessMode::ReadWrite)];

/// Replaces an idle timeout of 0, which means no limit.
const UNLIMITED: Duration = Duration::from_secs(366 * 24 * 3600);

/// Area, first address, how many items.
type Range = (String, u16, u32);

/// What may be read, and what may be written; `None` is everything.
type Limits = (Option<Vec<Range>>, Option<Vec<Range>>);

/// The rights of a unit: access, functions, denied functions, ranges.
type Narrow = (String, Option<Vec<i128>>, Option<Vec<i128>>, Limits);

/// What the peers of some networks may do, or the client of a serial line.
///
/// `units` maps unit ids, 0 to 255, to memories, routes and passages. `sources` are networks or
/// addresses, IPv4 or IPv6; a peer's IPv4-mapped IPv6 address counts as its IPv4 address. A network
/// requires them, a serial line has none. Set `functions`, the allowed function codes, or `deny`,
/// the codes that are not allowed, but not both. `roles`, only with TLS, are the allowed roles of
/// the peer's certificate: "" is a certificate without a role, `None` is any role. `narrowed` are
/// units with rights of their own: access, functions, denied functions, and the ranges that they
/// may read and write, each an area, its first address and a count; `None` is everything.
/// `exception_status` is where units have the eight bits that function 7 reads: area and address.
/// `fifo` are the addresses where units have the queues that function 24 reads. Other units do not
/// have these functions.
///
/// Raises `ValueError` for an invalid source or access.
#[pyclass(frozen, module = "holdfast")]
pub struct Rule {
    core: CoreRule,
    has_sources: bool,
}

#[pymethods]
impl Rule {
    #[new]
    #[pyo3(signature = (units, *, access, sources=None, functions=None, deny=None, roles=None, narrowed=None, exception_status=None, fifo=None))]
    #[expect(clippy::too_many_arguments, reason = "they are keywords of Python")]
    fn new(
        units: &Bound<'_, PyMapping>,
        access: &str,
        sources: Option<Vec<String>>,
        functions: Option<Vec<i128>>,
        deny: Option<Vec<i128>>,
        roles: Option<Vec<String>>,
        narrowed: Option<BTreeMap<i128, Narrow>>,
        exception_status: Option<BTreeMap<i128, (String, i128)>>,
        fifo: Option<BTreeMap<i128, Vec<i128>>>,
    ) -> PyResult<Rule> {
        let access = word("access", access, &ACCESS)?;
        let functions = self::functions(functions, deny)?;
        let narrowed = narrowed.unwrap_or_default().into_iter().map(|(unit, own)| {
            let (access, functions, deny, (read, write)) = own;
            let narrowed = Narrowed {
                access: word("access", &access, &ACCESS)?,
                functions: self::functions(functions, deny)?,
                ranges: Ranges::new(ranges(read)?, ranges(write)?),
                exception_status: None,
                queues: Box::default(),
            };
            Ok((byte("unit id", unit)?, narrowed))
        });
        let mut narrowed = narrowed.collect::<PyResult<BTreeMap<u8, Narrowed>>>()?;
        let of_rule = || Narrowed {
            access,
            functions: functions.clone(),
            ranges: Ranges::default(),
            exception_status: None,
            queues: Box::default(),
        };
        for (unit, (area, address)) in exception_status.unwrap_or_default() {
            let own = narrowed.entry(byte("unit id", unit)?).or_insert_with(of_rule);
            own.exception_status = Some(bits(&area, address)?);
        }
        for (unit, addresses) in fifo.unwrap_or_default() {
            let own = narrowed.entry(byte("unit id", unit)?).or_insert_with(of_rule);
            let address = |address| Ok(within("address", address, 0..=65_535)? as u16);
            own.queues = addresses.into_iter().map(address).collect::<PyResult<_>>()?;
        }
        let (mut memories, mut destinations) = (Vec::new(), Vec::new());
        for item in units.items()?.iter() {
            let (unit, target): (i128, Bound<'_, PyAny>) = item.extract()?;
            let unit = byte("unit id", unit)?;
            if let Ok(route) = target.extract::<PyRef<'_, Route>>() {
                destinations.push((unit, RequestDestination::Device(route.core.clone())));
            } else if let Ok(passage) = target.extract::<PyRef<'_, Passage>>() {
                memories.push((unit, Arc::clone(&passage.core.memory)));
                destinations.push((unit, RequestDestination::Mirror(Arc::clone(&passage.core))));
            } else {
                let memory: PyRef<'_, Memory> = target.extract()?;
                memories.push((unit, Arc::clone(&memory.core)));
            }
        }
        Ok(Rule {
            has_sources: sources.is_some(),
            core: CoreRule {
                sources: networks(&sources.unwrap_or_default())?,
                roles,
                units: memories,
                destinations,
                access,
                functions,
                narrowed: narrowed.into_iter().collect(),
            },
        })
    }

    /// The networks of the peers; `None` if none were given, as on a serial line.
    #[getter]
    fn sources(&self) -> Option<Vec<String>> {
        let sources = self.core.sources.iter().map(ToString::to_string);
        self.has_sources.then(|| sources.collect())
    }

    /// The roles of certificates; `None` is any role.
    #[getter]
    fn roles(&self) -> Option<Vec<String>> {
        self.core.roles.clone()
    }

    /// The unit ids of `units`.
    #[getter]
    fn unit_ids(&self) -> BTreeSet<u8> {
        let memories = self.core.units.iter().map(|(unit, _)| *unit);
        memories.chain(self.core.destinations.iter().map(|(unit, _)| *unit)).collect()
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
        targets: BTreeMap<i128, PyRef<'_, Memory>>,
        sources: Vec<String>,
        areas: Vec<String>,
        roles: Option<Vec<String>>,
    ) -> PyResult<RawRule> {
        let targets = targets.into_iter().map(|(target, memory)| {
            let target = within("unit or memory id", target, 0..=65_535)? as u16;
            Ok((target, Arc::clone(&memory.core)))
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

/// The options of a listener for connections, see `StreamOptions` in
/// `python/holdfast/server/options.py`. Here and below, other keys of the mapping are ignored.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct StreamOptions<'py> {
    framing: String,
    max_connections: i128,
    max_connections_per_source: Option<i128>,
    when_full: String,
    idle_timeout: f64,
    request_timeout: f64,
    frame_timeout: f64,
    keepalive: i128,
    listen_only: bool,
    event_log: bool,
    tls: Option<PyRef<'py, ServerTls>>,
    max_handshakes: i128,
    raw_ingest: Option<PyRef<'py, Listener>>,
}

#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct DatagramOptions {
    framing: String,
    listen_only: bool,
    event_log: bool,
}

#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct SerialOptions {
    mode: String,
    baud: i128,
    parity: String,
    stop_bits: i128,
    data_bits: i128,
    silence: Option<f64>,
    rs485: Option<String>,
    event_log: bool,
}

#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct RawIngestOptions<'py> {
    format: String,
    crc: String,
    flags: String,
    max_connections: i128,
    max_connections_per_source: Option<i128>,
    when_full: String,
    request_timeout: f64,
    packets: String,
    idle_timeout: f64,
    after_refusal: String,
    tls: Option<PyRef<'py, ServerTls>>,
    max_handshakes: Option<i128>,
}

#[pymethods]
impl Listener {
    #[new]
    fn new(
        name: String,
        bind: &str,
        rules: Vec<PyRef<'_, Rule>>,
        options: StreamOptions<'_>,
    ) -> PyResult<Listener> {
        let framings = [
            ("mbap", StreamFraming::Mbap),
            ("rtu", StreamFraming::Rtu),
            ("ascii", StreamFraming::Ascii),
        ];
        let framing = word("framing", &options.framing, &framings)?;
        let raw_ingest = match options.raw_ingest.map(|listener| listener.core.kind.clone()) {
            None => None,
            Some(ListenerKind::RawIngest(settings))
                if framing == StreamFraming::Mbap
                    && options.tls.is_none()
                    && settings.tls.is_none() =>
            {
                Some(settings)
            }
            Some(_) => {
                let message =
                    "raw_ingest must be a Raw Ingest listener; framing must be mbap, without tls";
                return Err(PyValueError::new_err(message));
            }
        };
        let idle_timeout = seconds("idle_timeout", options.idle_timeout)?;
        let frame_timeout = time_to_wait("frame_timeout", options.frame_timeout)?;
        let limits = limits(
            options.max_connections,
            options.max_connections_per_source,
            &options.when_full,
        )?;
        let kind = ListenerKind::ModbusStream(StreamSettings {
            bind: address(bind)?,
            framing,
            rules: cores(&rules),
            limits: secure_limits(limits, options.tls.is_some(), Some(options.max_handshakes))?,
            idle_timeout: (!idle_timeout.is_zero()).then_some(idle_timeout),
            request_timeout: time_to_wait("request_timeout", options.request_timeout)?,
            frame_timeout: (framing == StreamFraming::Rtu).then_some(frame_timeout),
            keepalive: Duration::from_secs(
                within("keepalive", options.keepalive, 1..=32_767)? as u64
            ),
            units: UnitSettings { listen_only: options.listen_only, event_log: options.event_log },
            tls: options.tls.map(|tls| tls.of(Protocol::Modbus)).transpose()?,
            raw_ingest,
        });
        Ok(Listener { core: ListenerSettings { name, kind } })
    }

    #[staticmethod]
    fn udp(
        name: String,
        bind: &str,
        rules: Vec<PyRef<'_, Rule>>,
        options: DatagramOptions,
    ) -> PyResult<Listener> {
        let framings = [("mbap", DatagramFraming::Mbap), ("rtu", DatagramFraming::Rtu)];
        let udp = UdpSettings {
            bind: address(bind)?,
            framing: word("framing", &options.framing, &framings)?,
            rules: cores(&rules),
            units: UnitSettings { listen_only: options.listen_only, event_log: options.event_log },
        };
        Ok(Listener { core: ListenerSettings { name, kind: ListenerKind::ModbusUdp(udp) } })
    }

    #[staticmethod]
    fn serial(
        name: String,
        device: String,
        rule: PyRef<'_, Rule>,
        options: SerialOptions,
    ) -> PyResult<Listener> {
        let SerialOptions { mode, baud, parity, stop_bits, data_bits, silence, rs485, event_log } =
            options;
        let line = line(device, &mode, baud, &parity, stop_bits, data_bits, silence, rs485)?;
        let units = UnitSettings { listen_only: true, event_log };
        let rule = rule.core.clone();
        let kind = ListenerKind::ModbusSerial(SerialSettings { line, rule, units });
        Ok(Listener { core: ListenerSettings { name, kind } })
    }

    #[staticmethod]
    fn raw_ingest(
        name: String,
        bind: &str,
        rules: Vec<PyRef<'_, RawRule>>,
        options: RawIngestOptions<'_>,
    ) -> PyResult<Listener> {
        let idle = match seconds("idle_timeout", options.idle_timeout)? {
            Duration::ZERO => UNLIMITED,
            idle => idle,
        };
        let refusals = [("close", AfterRefusal::Close), ("continue", AfterRefusal::Continue)];
        let after_refusal = word("after_refusal", &options.after_refusal, &refusals)?;
        let many = PacketsPerConnection::Many { idle, after_refusal };
        let packets = [("one", PacketsPerConnection::One), ("many", many)];
        let flags = [("strict", Flags::Strict), ("ignore", Flags::Ignore)];
        let limits = limits(
            options.max_connections,
            options.max_connections_per_source,
            &options.when_full,
        )?;
        let kind = ListenerKind::RawIngest(RawSettings {
            bind: address(bind)?,
            format: packet_format(&options.format, &options.crc)?,
            flags: word("flags", &options.flags, &flags)?,
            rules: rules.iter().map(|rule| rule.core.clone()).collect(),
            limits: secure_limits(limits, options.tls.is_some(), options.max_handshakes)?,
            request_timeout: time_to_wait("request_timeout", options.request_timeout)?,
            packets: word("packets", &options.packets, &packets)?,
            tls: options.tls.map(|tls| tls.of(Protocol::Modbus)).transpose()?,
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

/// Eight bits, from an address of an area of bits.
fn bits(area: &str, address: i128) -> PyResult<(Area, u16)> {
    let allowed = [Area::Coils, Area::DiscreteInputs].map(|area| (area.name(), area));
    let allowed = allowed.each_ref().map(|(name, area)| (&**name, *area));
    let area = word("area", area, &allowed)?;
    Ok((area, within("address", address, 0..=65_528)? as u16))
}

fn cores(rules: &[PyRef<'_, Rule>]) -> Vec<CoreRule> {
    rules.iter().map(|rule| rule.core.clone()).collect()
}

fn networks(sources: &[String]) -> PyResult<Vec<IpNet>> {
    sources.iter().map(|text| network(text)).collect()
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
    max_handshakes: Option<i128>,
) -> PyResult<ConnectionLimits> {
    let most = max_handshakes.map(|most| within("max_handshakes", most, 1..=65_535)).transpose()?;
    if has_tls && most.is_none() {
        return Err(PyValueError::new_err("max_handshakes is None, with tls it must be a number"));
    }
    Ok(ConnectionLimits { max_handshakes: most.filter(|_| has_tls), ..limits })
}
