// The driver of github.com/simonvetter/modbus: a client over TCP, UDP, RTU over both and a serial
// line, and a server over TCP.
package main

import (
	"bufio"
	"encoding/json"
	"fmt"
	"log"
	"net"
	"os"
	"strconv"
	"strings"
	"sync"
	"time"

	"github.com/simonvetter/modbus"
)

type operation struct {
	Call    string
	Address uint16
	Count   uint16
	Value   uint16
	Values  []uint16
}

var schemes = strings.NewReplacer("rtu+tcp://", "rtuovertcp://", "rtu+udp://", "rtuoverudp://")

var exceptions = map[error]int{
	modbus.ErrIllegalFunction:         1,
	modbus.ErrIllegalDataAddress:      2,
	modbus.ErrIllegalDataValue:        3,
	modbus.ErrServerDeviceFailure:     4,
	modbus.ErrGWTargetFailedToRespond: 11,
}

var quiet = log.New(os.Stderr, "", 0)

func fail(err error) {
	fmt.Fprintln(os.Stderr, err)
	os.Exit(1)
}

func runClient(url string, unit uint8) {
	client, err := modbus.NewClient(&modbus.ClientConfiguration{
		URL: schemes.Replace(url), Speed: 19200, Timeout: 10 * time.Second, Logger: quiet,
	})
	if err != nil {
		fail(err)
	}
	if err := client.Open(); err != nil {
		fail(err)
	}
	if err := client.SetUnitId(unit); err != nil {
		fail(err)
	}
	lines := bufio.NewScanner(os.Stdin)
	lines.Buffer(nil, 1<<20)
	answers := json.NewEncoder(os.Stdout)
	for lines.Scan() {
		var asked operation
		if err := json.Unmarshal(lines.Bytes(), &asked); err != nil {
			fail(err)
		}
		value, err := execute(client, asked)
		answer := map[string]any{"value": value}
		if code, is := exceptions[err]; is {
			answer = map[string]any{"exception": code}
		} else if err != nil {
			answer = map[string]any{"error": err.Error()}
		}
		if err := answers.Encode(answer); err != nil {
			fail(err)
		}
	}
}

func execute(client *modbus.ModbusClient, asked operation) (any, error) {
	switch asked.Call {
	case "read_coils":
		return numbers(client.ReadCoils(asked.Address, asked.Count))
	case "read_discrete_inputs":
		return numbers(client.ReadDiscreteInputs(asked.Address, asked.Count))
	case "read_holding_registers":
		return client.ReadRegisters(asked.Address, asked.Count, modbus.HOLDING_REGISTER)
	case "read_input_registers":
		return client.ReadRegisters(asked.Address, asked.Count, modbus.INPUT_REGISTER)
	case "write_coil":
		return nil, client.WriteCoil(asked.Address, asked.Value == 1)
	case "write_register":
		return nil, client.WriteRegister(asked.Address, asked.Value)
	case "write_coils":
		bits := make([]bool, len(asked.Values))
		for at, value := range asked.Values {
			bits[at] = value == 1
		}
		return nil, client.WriteCoils(asked.Address, bits)
	case "write_registers":
		return nil, client.WriteRegisters(asked.Address, asked.Values)
	}
	return nil, fmt.Errorf("no call %s", asked.Call)
}

func numbers(bits []bool, err error) ([]int, error) {
	values := make([]int, len(bits))
	for at, bit := range bits {
		if bit {
			values[at] = 1
		}
	}
	return values, err
}

// device has 1000 items in every area.
type device struct {
	lock            sync.Mutex
	coils, discrete [1000]bool
	holding, input  [1000]uint16
}

func (own *device) HandleCoils(asked *modbus.CoilsRequest) ([]bool, error) {
	return serve(own, own.coils[:], asked.Addr, asked.Quantity, asked.Args)
}

func (own *device) HandleDiscreteInputs(asked *modbus.DiscreteInputsRequest) ([]bool, error) {
	return serve(own, own.discrete[:], asked.Addr, asked.Quantity, nil)
}

func (own *device) HandleHoldingRegisters(asked *modbus.HoldingRegistersRequest) ([]uint16, error) {
	return serve(own, own.holding[:], asked.Addr, asked.Quantity, asked.Args)
}

func (own *device) HandleInputRegisters(asked *modbus.InputRegistersRequest) ([]uint16, error) {
	return serve(own, own.input[:], asked.Addr, asked.Quantity, nil)
}

func serve[Item any](own *device, area []Item, at, count uint16, values []Item) ([]Item, error) {
	own.lock.Lock()
	defer own.lock.Unlock()
	if int(at)+int(count) > len(area) {
		return nil, modbus.ErrIllegalDataAddress
	}
	copy(area[at:], values)
	return append([]Item(nil), area[at:at+count]...), nil
}

func runServer() {
	own := &device{}
	for at := range own.input {
		own.input[at] = uint16(at)
		own.discrete[at] = at%3 == 0
	}
	// The server does not tell its port: it gets one that was free.
	free, err := net.Listen("tcp", "127.0.0.1:0")
	if err != nil {
		fail(err)
	}
	address := free.Addr().(*net.TCPAddr)
	free.Close()
	server, err := modbus.NewServer(&modbus.ServerConfiguration{
		URL: "tcp://" + address.String(), Logger: quiet,
	}, own)
	if err != nil {
		fail(err)
	}
	if err := server.Start(); err != nil {
		fail(err)
	}
	fmt.Println(address.Port)
	select {}
}

func main() {
	if os.Args[1] == "server" {
		runServer()
		return
	}
	unit, err := strconv.ParseUint(os.Args[3], 10, 8)
	if err != nil {
		fail(err)
	}
	runClient(os.Args[2], uint8(unit))
}
