//! A Modbus TCP client that writes three holding registers and reads them back.
//!
//! Run `cargo run --example client -- 127.0.0.1:5020`.

use std::error::Error;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use holdfast_protocol::frame::mbap::{self, Next};
use holdfast_protocol::pdu::{self, Range, Registers, Request, Response};

fn main() -> Result<(), Box<dyn Error>> {
    let server = std::env::args().nth(1).unwrap_or_else(|| "127.0.0.1:5020".into());
    println!("{:?}", write_and_read(&server, 0, &[10, 20, 30])?);
    Ok(())
}

pub fn write_and_read(
    server: &str,
    first: u16,
    values: &[u16],
) -> Result<Vec<u16>, Box<dyn Error>> {
    let mut stream = TcpStream::connect(server)?;
    stream.set_read_timeout(Some(Duration::from_secs(5)))?;
    let mut room = [0; pdu::MAX_LEN];
    let registers = Registers::pack(values, &mut room)?;
    call(&mut stream, 1, &Request::WriteMultipleRegisters { address: first, registers })?;
    let range = Range::new(first, registers.quantity())?;
    call(&mut stream, 2, &Request::ReadHoldingRegisters(range))
}

/// Sends a request to unit 1 and waits for the response: registers, or nothing after a write.
fn call(stream: &mut TcpStream, id: u16, request: &Request) -> Result<Vec<u16>, Box<dyn Error>> {
    let (mut pdu, mut frame) = ([0; pdu::MAX_LEN], [0; mbap::MAX_LEN]);
    let len = request.encode(&mut pdu);
    let len = mbap::encode(id, 1, &pdu[..len], &mut frame).expect("a request has a PDU");
    stream.write_all(&frame[..len])?;
    let mut len = 0;
    loop {
        match mbap::next(&frame[..len]) {
            Next::Incomplete => match stream.read(&mut frame[len..])? {
                0 => return Err("the server closed the connection".into()),
                more => len += more,
            },
            Next::Frame { transaction_id, unit_id: 1, pdu, .. } if transaction_id == id => {
                return match request.response(pdu)? {
                    Response::Registers(registers) => Ok(registers.iter().collect()),
                    _ => Ok(Vec::new()),
                };
            }
            other => return Err(format!("not the response to request {id}: {other:?}").into()),
        }
    }
}
