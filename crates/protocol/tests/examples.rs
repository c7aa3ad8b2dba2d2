//! Runs the examples against each other.

use std::net::TcpListener;
use std::thread;

use holdfast_protocol::pdu::{ExceptionCode, RequestError, ResponseError};

#[allow(dead_code, reason = "the test calls what is below `main`")]
#[path = "../examples/client.rs"]
mod client;

#[allow(dead_code, reason = "the test calls what is below `main`")]
#[path = "../examples/server.rs"]
mod server;

#[test]
fn the_example_client_writes_and_reads_registers_of_the_example_server() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    thread::spawn(move || server::serve(&listener));

    assert_eq!(client::write_and_read(&address, 97, &[10, 20, 30]).unwrap(), [10, 20, 30]);

    let refused = client::write_and_read(&address, 98, &[1, 2, 3]).unwrap_err();
    let expected = ResponseError::Exception(ExceptionCode::IllegalDataAddress);
    assert_eq!(refused.downcast_ref(), Some(&expected));

    let refused = client::write_and_read(&address, 0, &[0; 124]).unwrap_err();
    let expected = RequestError::Quantity { found: 124, max: 123 };
    assert_eq!(refused.downcast_ref(), Some(&expected));
}
