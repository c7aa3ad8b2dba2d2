//! Generates requests and bytes for tests.
#![allow(dead_code, reason = "not every test uses all of it")]

use holdfast_protocol::pdu::identification::ReadCode;
use holdfast_protocol::pdu::{
    self, Bits, Diagnostics, FileRange, FileRanges, FileRecords, Function, Range, Registers,
    Request, SubFunction, limit,
};
use proptest::prelude::*;

/// A request whose parts own their data.
#[derive(Debug, Clone)]
pub enum Parts {
    Whole(Request<'static>),
    Bits(u16, u16, Vec<u8>),
    Registers(u16, Vec<u8>),
    ReadWrite(Range<{ limit::READ_REGISTERS }>, u16, Vec<u8>),
    Diagnostics(SubFunction, Vec<u8>),
    /// A PDU that parses.
    Encoded(Vec<u8>),
}

impl Parts {
    pub fn request(&self) -> Request<'_> {
        match self {
            Parts::Whole(request) => *request,
            Parts::Bits(address, quantity, bytes) => {
                let bits = Bits::new(*quantity, bytes).unwrap();
                Request::WriteMultipleCoils { address: *address, bits }
            }
            Parts::Registers(address, bytes) => {
                let registers = Registers::new(bytes).unwrap();
                Request::WriteMultipleRegisters { address: *address, registers }
            }
            Parts::ReadWrite(read, write_address, bytes) => Request::ReadWriteMultipleRegisters {
                read: *read,
                write_address: *write_address,
                registers: Registers::new(bytes).unwrap(),
            },
            Parts::Diagnostics(sub_function, data) => {
                Request::Diagnostics(Diagnostics::new(*sub_function, data).unwrap())
            }
            Parts::Encoded(pdu) => Request::parse(pdu).unwrap(),
        }
    }
}

pub fn a_range<const MAX: u16>() -> impl Strategy<Value = Range<MAX>> {
    (any::<u16>(), 1..=MAX).prop_map(|(address, quantity)| Range::new(address, quantity).unwrap())
}

fn data(len: usize) -> impl Strategy<Value = Vec<u8>> {
    prop::collection::vec(any::<u8>(), len)
}

fn registers(most: u16) -> impl Strategy<Value = Vec<u8>> {
    (1..=most).prop_flat_map(|quantity| data(usize::from(quantity) * 2))
}

fn a_sub_function() -> impl Strategy<Value = Parts> {
    let codes = prop::sample::select(SubFunction::ALL);
    (codes, any::<bool>(), 0..=0x7Fu8, 1..=125usize).prop_flat_map(|(code, clear, key, words)| {
        let len = if code == SubFunction::ReturnQueryData { words * 2 } else { 2 };
        data(len).prop_map(move |any_words| {
            let data = match code {
                SubFunction::ReturnQueryData => any_words,
                SubFunction::RestartCommunications => vec![if clear { 0xFF } else { 0x00 }, 0],
                SubFunction::ChangeAsciiInputDelimiter => vec![key, 0],
                _ => vec![0, 0],
            };
            Parts::Diagnostics(code, data)
        })
    })
}

/// Reads and writes of 1 to 8 ranges of files, or of one that takes the whole PDU.
fn of_files() -> impl Strategy<Value = Parts> {
    let heads = prop::collection::vec((1..=u16::MAX, 0..=limit::LAST_RECORD), 1..=8);
    (heads, 1..=limit::WRITE_RECORDS, any::<bool>(), any::<u16>()).prop_map(
        |(heads, most, writes, value)| {
            let (mut room, mut out) = ([0; pdu::MAX_LEN], [0; pdu::MAX_LEN]);
            let all = if writes { limit::WRITE_RECORDS } else { limit::READ_RECORDS };
            let quantity = match heads.len() {
                1 => most.min(all),
                several => 1 + most % (limit::WRITE_RECORDS / several as u16 - 4),
            };
            let len = if writes {
                let records = vec![value; usize::from(quantity)];
                let ranges: Vec<_> =
                    heads.iter().map(|(file, record)| (*file, *record, &records[..])).collect();
                let records = FileRecords::pack(&ranges, &mut room).unwrap();
                Request::WriteFileRecord(records).encode(&mut out)
            } else {
                let range = |(file, record)| FileRange::new(file, record, quantity).unwrap();
                let ranges: Vec<_> = heads.into_iter().map(range).collect();
                let ranges = FileRanges::pack(&ranges, &mut room).unwrap();
                Request::ReadFileRecord(ranges).encode(&mut out)
            };
            Parts::Encoded(out[..len].to_vec())
        },
    )
}

/// Requests of every function, with all values that they can have. A test of `properties.rs` fails if one is
/// missing.
pub fn a_request() -> impl Strategy<Value = Parts> {
    let code = prop::sample::select(ReadCode::ALL);
    let whole = prop_oneof![
        a_range().prop_map(Request::ReadCoils),
        a_range().prop_map(Request::ReadDiscreteInputs),
        a_range().prop_map(Request::ReadHoldingRegisters),
        a_range().prop_map(Request::ReadInputRegisters),
        any::<(u16, bool)>()
            .prop_map(|(address, value)| Request::WriteSingleCoil { address, value }),
        any::<(u16, u16)>()
            .prop_map(|(address, value)| Request::WriteSingleRegister { address, value }),
        any::<(u16, u16, u16)>().prop_map(|(address, and_mask, or_mask)| {
            Request::MaskWriteRegister { address, and_mask, or_mask }
        }),
        (code, any::<u8>())
            .prop_map(|(code, object_id)| Request::ReadDeviceIdentification { code, object_id }),
        Just(Request::ReadExceptionStatus),
        Just(Request::GetCommEventCounter),
        Just(Request::GetCommEventLog),
        any::<u16>().prop_map(|address| Request::ReadFifoQueue { address }),
        Just(Request::ReportServerId),
    ];
    prop_oneof![
        4 => whole.prop_map(Parts::Whole),
        1 => (any::<u16>(), 1..=limit::WRITE_BITS).prop_flat_map(|(address, quantity)| {
            data(usize::from(quantity).div_ceil(8))
                .prop_map(move |bytes| Parts::Bits(address, quantity, bytes))
        }),
        1 => (any::<u16>(), registers(limit::WRITE_REGISTERS))
            .prop_map(|(address, bytes)| Parts::Registers(address, bytes)),
        1 => (a_range(), any::<u16>(), registers(limit::READ_WRITE_REGISTERS))
            .prop_map(|(read, address, bytes)| Parts::ReadWrite(read, address, bytes)),
        1 => a_sub_function(),
        1 => of_files(),
    ]
}

/// Mostly PDUs of known functions, so that the checks after the first byte are reached.
pub fn bytes_like_a_pdu() -> impl Strategy<Value = Vec<u8>> {
    let code = prop_oneof![
        9 => prop::sample::select(Function::ALL).prop_map(Function::code),
        1 => any::<u8>()
    ];
    (code, prop::collection::vec(prop_oneof![Just(0), any::<u8>()], 0..253))
        .prop_map(|(code, body)| std::iter::once(code).chain(body).collect())
}
