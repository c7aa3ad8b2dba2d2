//! The driver of tokio-modbus: a client and a server over TCP and RTU over TCP.

use std::error::Error;
use std::future;
use std::io::{self, BufRead};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use serde_json::{json, Value};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::timeout;
use tokio_modbus::client::Context;
use tokio_modbus::prelude::*;
use tokio_modbus::server::{rtu_over_tcp, tcp, Service};

const TIMEOUT: Duration = Duration::from_secs(10);

type Failure = Box<dyn Error + Send + Sync>;

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Failure> {
    let words: Vec<String> = std::env::args().collect();
    let (scheme, address) = words[2].split_once("://").ok_or("no URL")?;
    if words[1] == "client" {
        run_client(scheme, address.parse()?, Slave(words[3].parse()?)).await
    } else {
        run_server(scheme).await
    }
}

async fn run_client(scheme: &str, address: SocketAddr, unit: Slave) -> Result<(), Failure> {
    let stream = TcpStream::connect(address).await?;
    let mut client = match scheme {
        "tcp" => client::tcp::attach_slave(stream, unit),
        _ => client::rtu::attach_slave(stream, unit),
    };
    for line in io::stdin().lock().lines() {
        let operation: Value = serde_json::from_str(&line?)?;
        let result = match timeout(TIMEOUT, call(&mut client, &operation)).await? {
            Ok(Ok(value)) => json!({ "value": value }),
            Ok(Err(exception)) => json!({ "exception": u8::from(exception) }),
            Err(error) => json!({ "error": error.to_string() }),
        };
        println!("{result}");
    }
    Ok(())
}

async fn call(client: &mut Context, operation: &Value) -> tokio_modbus::Result<Value> {
    let number = |name: &str| operation[name].as_u64().unwrap_or_default() as u16;
    let values: Vec<u16> = operation["values"]
        .as_array()
        .map(|values| values.iter().filter_map(Value::as_u64).map(|value| value as u16).collect())
        .unwrap_or_default();
    let bits: Vec<bool> = values.iter().map(|value| *value == 1).collect();
    let numbers = |bits: Vec<bool>| json!(bits.into_iter().map(u8::from).collect::<Vec<_>>());
    let words = |words: Vec<u16>| json!(words);
    let nothing = |()| Value::Null;
    let (at, count) = (number("address"), number("count"));
    Ok(match operation["call"].as_str().unwrap_or_default() {
        "read_coils" => client.read_coils(at, count).await?.map(numbers),
        "read_discrete_inputs" => client.read_discrete_inputs(at, count).await?.map(numbers),
        "read_holding_registers" => client.read_holding_registers(at, count).await?.map(words),
        "read_input_registers" => client.read_input_registers(at, count).await?.map(words),
        "write_coil" => client.write_single_coil(at, number("value") == 1).await?.map(nothing),
        "write_register" => client.write_single_register(at, number("value")).await?.map(nothing),
        "write_coils" => client.write_multiple_coils(at, &bits).await?.map(nothing),
        "write_registers" => client.write_multiple_registers(at, &values).await?.map(nothing),
        "mask_write" => {
            client.masked_write_register(at, number("and"), number("or")).await?.map(nothing)
        }
        "read_write" => client
            .read_write_multiple_registers(number("read_address"), count, at, &values)
            .await?
            .map(words),
        "identify" => identify(client, number("code") as u8, number("object") as u8).await?,
        call => return Err(io::Error::other(format!("no call {call}")).into()),
    })
}

async fn identify(client: &mut Context, code: u8, object: u8) -> tokio_modbus::Result<Value> {
    let code = ReadCode::try_from_value(code).ok_or_else(|| io::Error::other("no read code"))?;
    let reply = client.read_device_identification(code, object).await?;
    Ok(reply.map(|found| {
        let text = |object: &DeviceIdObject| String::from_utf8_lossy(&object.value).into_owned();
        found
            .device_id_objects
            .iter()
            .map(|object| (object.id.to_string(), json!(text(object))))
            .collect::<serde_json::Map<_, _>>()
            .into()
    }))
}

/// 1000 items in every area.
struct Areas {
    coils: Vec<bool>,
    discrete: Vec<bool>,
    holding: Vec<u16>,
    input: Vec<u16>,
}

#[derive(Clone)]
struct Device(Arc<Mutex<Areas>>);

impl Service for Device {
    type Request = Request<'static>;
    type Response = Response;
    type Exception = ExceptionCode;
    type Future = future::Ready<Result<Response, ExceptionCode>>;

    fn call(&self, request: Self::Request) -> Self::Future {
        let mut areas = self.0.lock().expect("no request panics");
        future::ready(answer(&mut areas, request))
    }
}

fn answer(areas: &mut Areas, request: Request<'static>) -> Result<Response, ExceptionCode> {
    Ok(match request {
        Request::ReadCoils(at, count) => {
            Response::ReadCoils(part(&mut areas.coils, at, count)?.to_vec())
        }
        Request::ReadDiscreteInputs(at, count) => {
            Response::ReadDiscreteInputs(part(&mut areas.discrete, at, count)?.to_vec())
        }
        Request::ReadHoldingRegisters(at, count) => {
            Response::ReadHoldingRegisters(part(&mut areas.holding, at, count)?.to_vec())
        }
        Request::ReadInputRegisters(at, count) => {
            Response::ReadInputRegisters(part(&mut areas.input, at, count)?.to_vec())
        }
        Request::WriteSingleCoil(at, coil) => {
            part(&mut areas.coils, at, 1)?[0] = coil;
            Response::WriteSingleCoil(at, coil)
        }
        Request::WriteSingleRegister(at, word) => {
            part(&mut areas.holding, at, 1)?[0] = word;
            Response::WriteSingleRegister(at, word)
        }
        Request::WriteMultipleCoils(at, coils) => {
            let count = coils.len() as u16;
            part(&mut areas.coils, at, count)?.copy_from_slice(&coils);
            Response::WriteMultipleCoils(at, count)
        }
        Request::WriteMultipleRegisters(at, words) => {
            let count = words.len() as u16;
            part(&mut areas.holding, at, count)?.copy_from_slice(&words);
            Response::WriteMultipleRegisters(at, count)
        }
        Request::MaskWriteRegister(at, and, or) => {
            let word = &mut part(&mut areas.holding, at, 1)?[0];
            *word = (*word & and) | (or & !and);
            Response::MaskWriteRegister(at, and, or)
        }
        Request::ReadWriteMultipleRegisters(from, count, at, words) => {
            part(&mut areas.holding, from, count)?;
            part(&mut areas.holding, at, words.len() as u16)?.copy_from_slice(&words);
            Response::ReadWriteMultipleRegisters(part(&mut areas.holding, from, count)?.to_vec())
        }
        _ => return Err(ExceptionCode::IllegalFunction),
    })
}

fn part<Item>(area: &mut [Item], at: u16, count: u16) -> Result<&mut [Item], ExceptionCode> {
    let (at, count) = (usize::from(at), usize::from(count));
    area.get_mut(at..at + count).ok_or(ExceptionCode::IllegalDataAddress)
}

async fn run_server(scheme: &str) -> Result<(), Failure> {
    let device = Device(Arc::new(Mutex::new(Areas {
        coils: vec![false; 1000],
        discrete: (0..1000).map(|at| at % 3 == 0).collect(),
        holding: vec![0; 1000],
        input: (0..1000).collect(),
    })));
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    println!("{}", listener.local_addr()?.port());
    let service = |_| Ok(Some(device.clone()));
    let on_error = |error: io::Error| eprintln!("{error}");
    if scheme == "tcp" {
        let connected =
            |stream, from| future::ready(tcp::accept_tcp_connection(stream, from, service));
        tcp::Server::new(listener).serve(&connected, on_error).await?;
    } else {
        let connected = |stream, from| {
            future::ready(rtu_over_tcp::accept_tcp_connection(stream, from, service))
        };
        rtu_over_tcp::Server::new(listener).serve(&connected, on_error).await?;
    }
    Ok(())
}
