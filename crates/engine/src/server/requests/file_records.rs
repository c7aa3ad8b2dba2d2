//! Functions 20 and 21: records of the files of a memory (V1.1b3, 6.14 and 6.15). All records of a
//! request are read at one moment, and written in one step or not at all.

use holdfast_memory::{Access, Area, Memory, Read, Write};
use holdfast_protocol::pdu::{self, Buffer, ExceptionCode, FileRanges, FileRecords, reply};

use crate::server::requests::exceptions::exception_of;
use crate::server::requests::writing;

pub(in crate::server) fn read(
    memory: &Memory,
    ranges: FileRanges<'_>,
    reply: &mut Buffer,
) -> Result<usize, ExceptionCode> {
    let mut records = [0; pdu::MAX_LEN];
    let mut rest = &mut records[..];
    let mut reads = Vec::new();
    for range in ranges.iter() {
        let count = usize::from(range.quantity());
        let (out, behind) = rest.split_at_mut(2 * count);
        reads.push(Read { area: Area::File(range.file()), address: range.record(), count, out });
        rest = behind;
    }
    let done = memory.read_many(Access::Client, &mut reads);
    done.map_err(|refused| exception_of(refused.refusal))?;
    let mut reads = reads.iter();
    let fill = |_, records: &mut [u8]| {
        if let Some(read) = reads.next() {
            records.copy_from_slice(read.out);
        }
    };
    Ok(reply::read_file_record(ranges, fill, reply))
}

pub(in crate::server) fn write(
    memory: &Memory,
    records: FileRecords<'_>,
    reply: &mut Buffer,
) -> Result<usize, ExceptionCode> {
    let done = memory.write_many(Access::Client, &writes(records));
    done.map_err(|refused| exception_of(refused.refusal))?;
    Ok(reply::write_file_record(records, reply))
}

/// What a request writes.
pub(in crate::server) fn writes(records: FileRecords<'_>) -> Vec<Write<'_>> {
    let writes = records.iter().map(|(range, records)| {
        let (area, address) = (Area::File(range.file()), range.record());
        writing(area, address, range.quantity(), records.as_bytes())
    });
    writes.collect()
}
