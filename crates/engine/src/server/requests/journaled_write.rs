//! Writes of Modbus requests that the journal of a memory carries out: their replies come when the
//! journal has kept them.

use holdfast_memory::{Access, Area, Memory, Operation, Outcome, Write};
use holdfast_protocol::pdu::{self, ExceptionCode, Request, reply};

use crate::link::{PendingReply, Reply, ReplyTo, confirmation, exception, pending_reply};
use crate::server::requests::exceptions::exception_of;
use crate::server::requests::file_records;
use crate::server::requests::writing;

/// Gives a write to the journal.
///
/// # Errors
/// The exception to refuse it with.
///
/// # Panics
/// The memory has no journal.
pub(in crate::server) fn submit(
    memory: &Memory,
    pdu: &[u8],
) -> Result<PendingReply, ExceptionCode> {
    let request = Request::parse(pdu)?;
    let (to, pending) = pending_reply();
    let answer = PendingAnswer { request: pdu.to_vec(), to: Some(to) };
    let give = |operation| {
        memory.submit(Access::Client, operation, Box::new(|outcome| answer.send(outcome)))
    };
    let registers = Area::HoldingRegisters;
    match request {
        Request::WriteSingleCoil { address, value } => {
            give(Operation::Write(&[writing(Area::Coils, address, 1, &[u8::from(value)])]))
        }
        Request::WriteSingleRegister { address, value } => {
            give(Operation::Write(&[writing(registers, address, 1, &value.to_be_bytes())]))
        }
        Request::WriteMultipleCoils { address, bits } => {
            let write = writing(Area::Coils, address, bits.quantity(), bits.as_bytes());
            give(Operation::Write(&[write]))
        }
        Request::WriteMultipleRegisters { address, registers: new } => {
            let write = writing(registers, address, new.quantity(), new.as_bytes());
            give(Operation::Write(&[write]))
        }
        Request::WriteFileRecord(records) => give(Operation::Write(&file_records::writes(records))),
        Request::MaskWriteRegister { address, and_mask, or_mask } => {
            give(Operation::Mask { area: registers, address, and_mask, or_mask })
        }
        Request::ReadWriteMultipleRegisters { read, write_address, registers: new } => {
            let write: Write = writing(registers, write_address, new.quantity(), new.as_bytes());
            let (address, count) = (read.address(), read.quantity().into());
            give(Operation::WriteThenRead { write, area: registers, address, count })
        }
        _ => return Err(ExceptionCode::IllegalFunction),
    }
    .map_err(exception_of)?;
    Ok(pending)
}

/// Carries out a write, and waits for the journal. Returns the reply, and where a log has the write.
pub(in crate::server) async fn carry_out(memory: &Memory, pdu: &[u8]) -> (Vec<u8>, Option<u64>) {
    let refused = |code: ExceptionCode| (exception(pdu, code.code()), None);
    match submit(memory, pdu) {
        Err(code) => refused(code),
        Ok(pending) => match pending.await {
            Ok(Reply { pdu, log_sequence }) => (pdu, log_sequence),
            Err(_) => refused(ExceptionCode::ServerDeviceFailure),
        },
    }
}

/// The reply to a write. If it is dropped, the outcome of the write is unknown.
struct PendingAnswer {
    request: Vec<u8>,
    to: Option<ReplyTo>,
}

impl PendingAnswer {
    fn send(mut self, outcome: Outcome) {
        let mut buffer = [0; pdu::MAX_LEN];
        let log_sequence = outcome.as_ref().ok().and_then(|done| done.sequence);
        let reply = match (&outcome, Request::parse(&self.request)) {
            (Err(refused), _) => exception(&self.request, exception_of(refused.refusal).code()),
            (Ok(done), Ok(Request::ReadWriteMultipleRegisters { read, .. })) => {
                let (out, len) = reply::read_write_multiple_registers(read, &mut buffer);
                out.copy_from_slice(&done.read);
                buffer[..len].to_vec()
            }
            (Ok(_), _) => {
                let len = confirmation(&self.request).len();
                self.request.truncate(len);
                std::mem::take(&mut self.request)
            }
        };
        if let Some(to) = self.to.take() {
            to.send_written(reply, log_sequence);
        }
    }
}

impl Drop for PendingAnswer {
    fn drop(&mut self) {
        if let Some(to) = self.to.take() {
            to.send(exception(&self.request, ExceptionCode::ServerDeviceFailure.code()));
        }
    }
}
