//! Connects to the first address of a host that accepts.

use std::io::{self, ErrorKind};
use std::net::SocketAddr;

use tokio::net::TcpStream;
use tokio::time::{Instant, timeout};

use crate::name_lookup;
use crate::socket_calls::not_to_itself;

/// Tries the addresses in order. Each but the last gets its share of the time until the deadline. The caller
/// limits the last one.
///
/// # Errors
/// The error of the last address.
pub(crate) async fn dial(addresses: Vec<SocketAddr>, deadline: Instant) -> io::Result<TcpStream> {
    let mut addresses = addresses.into_iter();
    while let Some(address) = addresses.next() {
        let others = addresses.len();
        if others == 0 {
            return connected(address).await;
        }
        let share = name_lookup::share(deadline.into_std(), others);
        if let Ok(Ok(stream)) = timeout(share, connected(address)).await {
            return Ok(stream);
        }
    }
    Err(io::Error::new(ErrorKind::NotFound, "the name has no address"))
}

async fn connected(address: SocketAddr) -> io::Result<TcpStream> {
    not_to_itself(TcpStream::connect(address).await?)
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;
    use std::time::Duration;

    use super::*;

    fn run(addresses: Vec<SocketAddr>) -> io::Result<TcpStream> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(dial(addresses, Instant::now() + Duration::from_secs(60)))
    }

    #[test]
    fn the_next_address_is_tried_and_the_last_one_says_why() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let there = listener.local_addr().unwrap();
        let nobody = SocketAddr::from(([127, 0, 0, 2], there.port()));
        assert_eq!(run(vec![nobody, there]).unwrap().peer_addr().unwrap(), there);
        assert_eq!(run(vec![nobody, nobody]).unwrap_err().kind(), ErrorKind::ConnectionRefused);
        assert_eq!(run(Vec::new()).unwrap_err().kind(), ErrorKind::NotFound);
    }
}
