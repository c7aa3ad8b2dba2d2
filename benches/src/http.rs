//! One HTTP request and its reply, for a load.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::ops::Range;

use crate::{Failure, TIMEOUT};

/// The length limit of a reply.
const REPLY: usize = 4096;

/// The first reply of the server, which must be 200, and where it has its date. Later replies may
/// only differ there.
pub(crate) fn first_reply(
    address: SocketAddr,
    request: &[u8],
) -> Result<(Vec<u8>, Range<usize>), Failure> {
    let mut stream = TcpStream::connect(address)?;
    stream.set_read_timeout(Some(TIMEOUT))?;
    stream.write_all(request)?;
    let mut buffer = [0; REPLY];
    let mut len = 0;
    loop {
        match stream.read(&mut buffer[len..])? {
            0 => return Err("the server closed a connection, or the reply is too long".into()),
            more => len += more,
        }
        let reply = &buffer[..len];
        if let Some(found) = whole(reply)? {
            return Ok((reply.to_vec(), found));
        }
    }
}

/// Where a reply has its date, if the reply is complete.
fn whole(reply: &[u8]) -> Result<Option<Range<usize>>, Failure> {
    let Some(head_len) = reply.windows(4).position(|four| four == b"\r\n\r\n") else {
        return Ok(None);
    };
    let head = str::from_utf8(&reply[..head_len])?.to_ascii_lowercase();
    if !head.starts_with("http/1.1 200 ") {
        return Err(String::from_utf8_lossy(reply).into());
    }
    let len = head.lines().find_map(|line| line.strip_prefix("content-length:"));
    let len: usize = len.ok_or("the reply has no content-length")?.trim().parse()?;
    if reply.len() > head_len + 4 + len {
        return Err("the reply is longer than its content-length".into());
    }
    let date = head.find("\r\ndate:").map_or(0..0, |start| {
        let end = head[start + 2..].find("\r\n").map_or(head_len, |end| start + 2 + end);
        start..end
    });
    Ok((reply.len() == head_len + 4 + len).then_some(date))
}
