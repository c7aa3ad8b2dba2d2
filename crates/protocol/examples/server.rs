//! A Modbus TCP server with 100 holding registers, one thread for each connection.
//!
//! Run `cargo run --example server`, then `cargo run --example client` in another terminal.

use std::io::{self, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Mutex, PoisonError};
use std::thread;

use holdfast_protocol::frame::mbap::{self, Next};
use holdfast_protocol::pdu::{self, ExceptionCode, Request, pack_registers, reply};

static REGISTERS: Mutex<[u16; 100]> = Mutex::new([0; 100]);

fn main() -> io::Result<()> {
    serve(&TcpListener::bind("127.0.0.1:5020")?)
}

pub fn serve(listener: &TcpListener) -> io::Result<()> {
    loop {
        let (stream, peer) = listener.accept()?;
        thread::spawn(move || println!("{peer}: {:?}", converse(stream)));
    }
}

/// Answers the requests of one connection until the peer closes it.
fn converse(mut stream: TcpStream) -> io::Result<()> {
    let (mut received, mut len) = ([0; mbap::MAX_LEN], 0);
    loop {
        let used = match mbap::next(&received[..len]) {
            Next::Frame { transaction_id, unit_id, pdu, len } => {
                let mut out = [0; pdu::MAX_LEN];
                let reply_len = answer(pdu, &mut out)
                    .unwrap_or_else(|code| reply::exception(pdu[0], code, &mut out));
                stream.write_all(&mbap::header(transaction_id, unit_id, reply_len))?;
                stream.write_all(&out[..reply_len])?;
                len
            }
            Next::Foreign { len, .. } => len,
            Next::Broken { .. } => return Err(io::ErrorKind::InvalidData.into()),
            Next::Incomplete => match stream.read(&mut received[len..])? {
                0 => return Ok(()),
                more => {
                    len += more;
                    continue;
                }
            },
        };
        received.copy_within(used..len, 0);
        len -= used;
    }
}

fn answer(request: &[u8], out: &mut pdu::Buffer) -> Result<usize, ExceptionCode> {
    let mut memory = REGISTERS.lock().unwrap_or_else(PoisonError::into_inner);
    match Request::parse(request)? {
        Request::ReadHoldingRegisters(range) => {
            let found = memory.get(range.indices()).ok_or(ExceptionCode::IllegalDataAddress)?;
            let (room, len) = reply::read_holding_registers(range, out);
            pack_registers(found, room);
            Ok(len)
        }
        Request::WriteMultipleRegisters { address, registers } => {
            let end = usize::from(address) + usize::from(registers.quantity());
            let place = memory.get_mut(address.into()..end);
            let place = place.ok_or(ExceptionCode::IllegalDataAddress)?;
            place.iter_mut().zip(registers.iter()).for_each(|(old, new)| *old = new);
            Ok(reply::write_multiple_registers(address, registers, out))
        }
        _ => Err(ExceptionCode::IllegalFunction),
    }
}
