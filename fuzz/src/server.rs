//! Requests to a server: [unit][length] PDU, again and again. A model that shares no code with the server, written
//! from docs/modbus.md, tells the replies and what the memory holds at the end.

use std::sync::Arc;

use holdfast_engine::server::requests::identity::Identity;
use holdfast_engine::server::requests::unit_server::{UnitServer, UnitSettings};
use holdfast_engine::server::rights::functions::{AccessMode, Functions};
use holdfast_engine::server::rights::peer_rights::PeerRights;
use holdfast_engine::server::rights::ranges::Ranges;
use holdfast_engine::server::rights::rule::{Narrowed, Rule};
use holdfast_memory::{Access, Area, Layout, Memory, Read, Span};
use holdfast_protocol::pdu;

const FILE: u16 = 4;
/// The areas of the model, in the order of the functions that read them, then the file: first address and size.
const AREAS: [(Area, u16, u16); 5] = [
    (Area::Coils, 3, 2100),
    (Area::DiscreteInputs, 65_500, 36),
    (Area::HoldingRegisters, 10, 300),
    (Area::InputRegisters, 0, 20),
    (Area::File(FILE), 0, 130),
];
const COILS: usize = 0;
const HOLDING_REGISTERS: usize = 2;
const RECORDS: usize = 4;

const ILLEGAL_FUNCTION: u8 = 1;
const ILLEGAL_ADDRESS: u8 = 2;
const ILLEGAL_VALUE: u8 = 3;
const NO_SUCH_UNIT: u8 = 0x0B;

/// A unit that is read and written, one of the same memory that is only read, and one that is not there.
const UNITS: [u8; 3] = [1, 2, 9];

/// Each reply is that of the model, and so is the memory in the end.
pub fn check(data: &[u8]) {
    let memory = memory();
    let (server, rights) = (server(), rights(&memory));
    let mut model = Model::new();
    let mut rest = data;
    while let [unit, behind @ ..] = rest {
        let (request, behind) = crate::counted(behind);
        rest = behind;
        let unit_id = UNITS[usize::from(*unit) % UNITS.len()];
        let request = &request[..request.len().min(pdu::MAX_LEN)];
        let mut buffer = [0; pdu::MAX_LEN];
        let Some(&code) = request.first() else { continue };
        let len = server.answer(&rights, unit_id, request, || true, &mut buffer);
        let reply = len.map(|len| &buffer[..len]).expect("listen only mode is not allowed");
        // Diagnostics, counters and identification: they change nothing, which the end shows.
        if matches!(code, 8 | 11 | 17 | 43) {
            assert_eq!(reply[0] & 0x7F, code);
            continue;
        }
        let expected =
            model.answer(unit_id, request).unwrap_or_else(|exception| vec![code | 0x80, exception]);
        assert_eq!(reply, expected, "unit {unit_id}, request {request:02x?}");
    }
    for ((area, start, size), values) in AREAS.into_iter().zip(&model.values) {
        let bytes =
            if is_bits(area) { usize::from(size).div_ceil(8) } else { usize::from(size) * 2 };
        let mut held = vec![0; bytes];
        let read = Read { area, address: start, count: size.into(), out: &mut held };
        memory.read(Access::Client, read).expect("the whole area");
        assert_eq!(held, packed(area, values), "{area:?}");
    }
}

fn memory() -> Arc<Memory> {
    let layout = AREAS.into_iter().fold(Layout::default(), |layout, (area, start, size)| {
        layout.with(area, Span::new(start, size.into()).expect("a span within the addresses"))
    });
    Arc::new(Memory::new(layout, None).expect("memory for a few items"))
}

fn server() -> UnitServer {
    let objects = [0, 1, 2].map(|id| (id, b"text".to_vec()));
    UnitServer::new(Identity::new(&objects, &[]).expect("short texts"), UnitSettings::default())
}

fn rights(memory: &Arc<Memory>) -> PeerRights {
    let narrowed = Narrowed {
        access: AccessMode::ReadOnly,
        functions: Functions::All,
        ranges: Ranges::new(None, None),
        exception_status: None,
        queues: Box::default(),
    };
    PeerRights::new(&Rule {
        sources: Vec::new(),
        roles: None,
        units: vec![(UNITS[0], Arc::clone(memory)), (UNITS[1], Arc::clone(memory))],
        destinations: Vec::new(),
        access: AccessMode::ReadWrite,
        functions: Functions::All,
        narrowed: vec![(UNITS[1], narrowed)],
    })
}

fn is_bits(area: Area) -> bool {
    matches!(area, Area::Coils | Area::DiscreteInputs)
}

/// The lowest bit of a byte first, or the high byte of a register first.
fn packed(area: Area, values: &[u16]) -> Vec<u8> {
    if !is_bits(area) {
        return values
            .iter()
            .flat_map(|value| [(value >> 8) as u8, (value & 0xFF) as u8])
            .collect();
    }
    let mut bytes = vec![0; values.len().div_ceil(8)];
    for (index, bit) in values.iter().enumerate() {
        bytes[index / 8] |= u8::from(*bit != 0) << (index % 8);
    }
    bytes
}

fn word(bytes: &[u8], at: usize) -> u16 {
    u16::from(bytes[at]) << 8 | u16::from(bytes[at + 1])
}

fn words(bytes: &[u8]) -> Vec<u16> {
    (0..bytes.len() / 2).map(|index| word(bytes, 2 * index)).collect()
}

fn require(holds: bool, exception: u8) -> Result<(), u8> {
    if holds { Ok(()) } else { Err(exception) }
}

/// What a client sees.
struct Model {
    values: [Vec<u16>; AREAS.len()],
}

impl Model {
    fn new() -> Model {
        Model { values: AREAS.map(|(_, _, size)| vec![0; size.into()]) }
    }

    /// The PDU of the reply, or the exception.
    fn answer(&mut self, unit_id: u8, pdu: &[u8]) -> Result<Vec<u8>, u8> {
        let code = pdu[0];
        let writes = matches!(code, 5 | 6 | 15 | 16 | 21 | 22 | 23);
        require(matches!(code, 1..=4 | 20) || writes, ILLEGAL_FUNCTION)?;
        require(!(writes && unit_id == UNITS[1]), ILLEGAL_FUNCTION)?;
        require(unit_id != UNITS[2], NO_SUCH_UNIT)?;
        match code {
            1..=4 => self.read(usize::from(code) - 1, pdu),
            5 => {
                require(pdu.len() == 5 && matches!(word(pdu, 3), 0 | 0xFF00), ILLEGAL_VALUE)?;
                self.put(COILS, word(pdu, 1), &[word(pdu, 3) >> 15])?;
                Ok(pdu.to_vec())
            }
            6 => {
                require(pdu.len() == 5, ILLEGAL_VALUE)?;
                self.put(HOLDING_REGISTERS, word(pdu, 1), &[word(pdu, 3)])?;
                Ok(pdu.to_vec())
            }
            15 => {
                require(pdu.len() >= 6, ILLEGAL_VALUE)?;
                let quantity = usize::from(word(pdu, 3));
                require((1..=1968).contains(&quantity), ILLEGAL_VALUE)?;
                is_counted(pdu, 5, quantity.div_ceil(8))?;
                let bits: Vec<u16> =
                    (0..quantity).map(|at| u16::from(pdu[6 + at / 8] >> (at % 8) & 1)).collect();
                self.put(COILS, word(pdu, 1), &bits)?;
                Ok(pdu[..5].to_vec())
            }
            16 => {
                require(pdu.len() >= 6, ILLEGAL_VALUE)?;
                let quantity = usize::from(word(pdu, 3));
                require((1..=123).contains(&quantity), ILLEGAL_VALUE)?;
                is_counted(pdu, 5, 2 * quantity)?;
                self.put(HOLDING_REGISTERS, word(pdu, 1), &words(&pdu[6..]))?;
                Ok(pdu[..5].to_vec())
            }
            20 => self.read_records(pdu),
            21 => self.write_records(pdu),
            22 => {
                require(pdu.len() == 7, ILLEGAL_VALUE)?;
                let (address, and_mask, or_mask) = (word(pdu, 1), word(pdu, 3), word(pdu, 5));
                let now = self.take(HOLDING_REGISTERS, address, 1)?[0];
                self.put(HOLDING_REGISTERS, address, &[now & and_mask | or_mask & !and_mask])?;
                Ok(pdu.to_vec())
            }
            _ => {
                require(pdu.len() >= 10, ILLEGAL_VALUE)?;
                let (count, quantity) = (word(pdu, 3), usize::from(word(pdu, 7)));
                require((1..=125).contains(&count), ILLEGAL_VALUE)?;
                require((1..=121).contains(&quantity), ILLEGAL_VALUE)?;
                is_counted(pdu, 9, 2 * quantity)?;
                self.take(HOLDING_REGISTERS, word(pdu, 1), count)?;
                self.put(HOLDING_REGISTERS, word(pdu, 5), &words(&pdu[10..]))?;
                Ok(self.reply(code, HOLDING_REGISTERS, word(pdu, 1), count)?)
            }
        }
    }

    fn read(&self, area: usize, pdu: &[u8]) -> Result<Vec<u8>, u8> {
        require(pdu.len() == 5, ILLEGAL_VALUE)?;
        let most = if is_bits(AREAS[area].0) { 2000 } else { 125 };
        require((1..=most).contains(&word(pdu, 3)), ILLEGAL_VALUE)?;
        self.reply(pdu[0], area, word(pdu, 1), word(pdu, 3))
    }

    fn reply(&self, code: u8, area: usize, address: u16, count: u16) -> Result<Vec<u8>, u8> {
        let data = packed(AREAS[area].0, self.take(area, address, count)?);
        Ok([&[code, data.len() as u8], &data[..]].concat())
    }

    fn read_records(&self, pdu: &[u8]) -> Result<Vec<u8>, u8> {
        let ranges = pdu.get(2..).unwrap_or_default();
        require(pdu.len() >= 2 && usize::from(pdu[1]) == ranges.len(), ILLEGAL_VALUE)?;
        require((7..=0xF5).contains(&ranges.len()) && ranges.len() % 7 == 0, ILLEGAL_VALUE)?;
        for range in ranges.chunks(7) {
            may_be_in_a_file(range)?;
        }
        let len: usize = ranges.chunks(7).map(|range| 2 + 2 * usize::from(word(range, 5))).sum();
        require(len <= 0xF5, ILLEGAL_VALUE)?;
        let mut reply = vec![20, len as u8];
        for range in ranges.chunks(7) {
            let records = self.records(range)?;
            reply.extend([1 + 2 * records.len() as u8, 6]);
            reply.extend(packed(Area::File(FILE), records));
        }
        Ok(reply)
    }

    fn write_records(&mut self, pdu: &[u8]) -> Result<Vec<u8>, u8> {
        let mut rest = pdu.get(2..).unwrap_or_default();
        require(pdu.len() >= 2 && usize::from(pdu[1]) == rest.len(), ILLEGAL_VALUE)?;
        require((9..=0xFB).contains(&rest.len()), ILLEGAL_VALUE)?;
        let mut ranges = Vec::new();
        while !rest.is_empty() {
            require(rest.len() >= 7, ILLEGAL_VALUE)?;
            let len = 7 + 2 * usize::from(word(rest, 5));
            require(rest.len() >= len, ILLEGAL_VALUE)?;
            may_be_in_a_file(rest)?;
            ranges.push(&rest[..len]);
            rest = &rest[len..];
        }
        for range in &ranges {
            self.records(range)?;
        }
        for range in ranges {
            self.put(RECORDS, word(range, 3), &words(&range[7..]))?;
        }
        Ok(pdu.to_vec())
    }

    fn records(&self, range: &[u8]) -> Result<&[u16], u8> {
        require(word(range, 1) == FILE, ILLEGAL_ADDRESS)?;
        self.take(RECORDS, word(range, 3), word(range, 5))
    }

    fn take(&self, area: usize, address: u16, count: u16) -> Result<&[u16], u8> {
        let start = address.checked_sub(AREAS[area].1).ok_or(ILLEGAL_ADDRESS)?;
        let start = usize::from(start);
        self.values[area].get(start..start + usize::from(count)).ok_or(ILLEGAL_ADDRESS)
    }

    fn put(&mut self, area: usize, address: u16, values: &[u16]) -> Result<(), u8> {
        self.take(area, address, values.len() as u16)?;
        let start = usize::from(address - AREAS[area].1);
        self.values[area][start..start + values.len()].copy_from_slice(values);
        Ok(())
    }
}

/// Whether the byte at `at` counts the bytes behind it, and these are as many as the quantity needs.
fn is_counted(pdu: &[u8], at: usize, needed: usize) -> Result<(), u8> {
    let behind = pdu.len() - at - 1;
    require(usize::from(pdu[at]) == behind && behind == needed, ILLEGAL_VALUE)
}

/// Whether a file of some server could have these records.
fn may_be_in_a_file(range: &[u8]) -> Result<(), u8> {
    let fits = word(range, 3) < 10_000 && (1..=122).contains(&word(range, 5));
    require(range[0] == 6 && word(range, 1) > 0 && fits, ILLEGAL_ADDRESS)
}
