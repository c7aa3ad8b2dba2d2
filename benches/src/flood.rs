//! An MQTT publisher that never pauses: it sends the same message, QoS 0, as fast as the broker
//! accepts it.

use std::fs;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};

use crate::{Failure, TIMEOUT, options};

/// MQTT 3.1.1, a clean session, no keep-alive, client id `flood`.
const CONNECT: &[u8] = b"\x10\x11\x00\x04MQTT\x04\x02\x00\x00\x00\x05flood";
const ACCEPTED: [u8; 4] = [0x20, 2, 0, 0];
const PUBLISH: u8 = 0x30;

/// Messages per write.
const TOGETHER: usize = 32;

/// `--address A --topic T --message FILE`: runs until it is killed.
pub(crate) fn main(arguments: lexopt::Parser) -> Result<(), Failure> {
    let mut address = SocketAddr::from(([127, 0, 0, 1], 1883));
    let (mut topic, mut message) = (String::new(), Vec::new());
    options(arguments, |name, value| {
        match name {
            "address" => address = value.parse()?,
            "topic" => topic = value,
            "message" => message = fs::read(value)?,
            _ => return Ok(false),
        }
        Ok(true)
    })?;
    let mut stream = TcpStream::connect(address)?;
    stream.set_read_timeout(Some(TIMEOUT))?;
    stream.write_all(CONNECT)?;
    let mut answer = [0; 4];
    stream.read_exact(&mut answer)?;
    if answer != ACCEPTED {
        return Err(format!("the broker answered {answer:?}").into());
    }
    let packets = publish(&topic, &message)?.repeat(TOGETHER);
    loop {
        stream.write_all(&packets)?;
    }
}

fn publish(topic: &str, message: &[u8]) -> Result<Vec<u8>, Failure> {
    let topic_len = u16::try_from(topic.len())?.to_be_bytes();
    let rest = [&topic_len, topic.as_bytes(), message].concat();
    let mut packet = vec![PUBLISH];
    let mut len = rest.len();
    while len >= 128 {
        packet.push(len as u8 & 127 | 128);
        len >>= 7;
    }
    packet.push(len as u8);
    packet.extend(rest);
    Ok(packet)
}
