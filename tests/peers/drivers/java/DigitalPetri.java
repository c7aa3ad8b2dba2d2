import com.digitalpetri.modbus.client.ModbusClient;
import com.digitalpetri.modbus.client.ModbusRtuClient;
import com.digitalpetri.modbus.client.ModbusTcpClient;
import com.digitalpetri.modbus.exceptions.ModbusResponseException;
import com.digitalpetri.modbus.pdu.MaskWriteRegisterRequest;
import com.digitalpetri.modbus.pdu.ReadCoilsRequest;
import com.digitalpetri.modbus.pdu.ReadDiscreteInputsRequest;
import com.digitalpetri.modbus.pdu.ReadHoldingRegistersRequest;
import com.digitalpetri.modbus.pdu.ReadInputRegistersRequest;
import com.digitalpetri.modbus.pdu.ReadWriteMultipleRegistersRequest;
import com.digitalpetri.modbus.pdu.WriteMultipleCoilsRequest;
import com.digitalpetri.modbus.pdu.WriteMultipleRegistersRequest;
import com.digitalpetri.modbus.pdu.WriteSingleCoilRequest;
import com.digitalpetri.modbus.pdu.WriteSingleRegisterRequest;
import com.digitalpetri.modbus.server.ModbusRtuServer;
import com.digitalpetri.modbus.server.ModbusServer;
import com.digitalpetri.modbus.server.ModbusTcpServer;
import com.digitalpetri.modbus.server.ProcessImage;
import com.digitalpetri.modbus.server.ReadWriteModbusServices;
import com.digitalpetri.modbus.tcp.client.NettyRtuClientTransport;
import com.digitalpetri.modbus.tcp.client.NettyTcpClientTransport;
import com.digitalpetri.modbus.tcp.server.NettyRtuServerTransport;
import com.digitalpetri.modbus.tcp.server.NettyTcpServerTransport;
import java.net.URI;
import java.time.Duration;
import java.util.Optional;

/** The driver of digitalpetri's Modbus: a client and a server over TCP and RTU over TCP. */
public final class DigitalPetri {
    private static final Duration TIMEOUT = Duration.ofSeconds(10);

    private DigitalPetri() {}

    public static void main(String[] words) throws Exception {
        URI url = URI.create(words[1]);
        if (words[0].equals("client")) {
            runClient(url, Integer.parseInt(words[2]));
        } else {
            runServer(url.getScheme());
        }
    }

    private static ModbusClient opened(URI url) {
        if (url.getScheme().equals("tcp")) {
            return ModbusTcpClient.create(NettyTcpClientTransport.create(to -> {
                to.hostname = url.getHost();
                to.port = url.getPort();
            }), options -> options.requestTimeout = TIMEOUT);
        }
        return ModbusRtuClient.create(NettyRtuClientTransport.create(to -> {
            to.hostname = url.getHost();
            to.port = url.getPort();
        }), options -> options.requestTimeout = TIMEOUT);
    }

    private static void runClient(URI url, int unit) throws Exception {
        ModbusClient client = opened(url);
        client.connect();
        JsonLines.answerAll(operation -> {
            try {
                return call(client, unit, operation);
            } catch (ModbusResponseException answer) {
                throw new JsonLines.Answered(answer.getExceptionCode());
            }
        });
    }

    private static Object call(ModbusClient client, int unit, JsonLines.Operation asked)
            throws Exception {
        int address = asked.number("address");
        int count = asked.number("count");
        int value = asked.number("value");
        int[] values = asked.values;
        switch (asked.call) {
            case "read_coils":
                return bits(client.readCoils(unit, new ReadCoilsRequest(address, count)).coils(),
                        count);
            case "read_discrete_inputs":
                return bits(client.readDiscreteInputs(unit,
                        new ReadDiscreteInputsRequest(address, count)).inputs(), count);
            case "read_holding_registers":
                return words(client.readHoldingRegisters(unit,
                        new ReadHoldingRegistersRequest(address, count)).registers());
            case "read_input_registers":
                return words(client.readInputRegisters(unit,
                        new ReadInputRegistersRequest(address, count)).registers());
            case "write_coil":
                client.writeSingleCoil(unit, new WriteSingleCoilRequest(address, value == 1));
                return null;
            case "write_register":
                client.writeSingleRegister(unit, new WriteSingleRegisterRequest(address, value));
                return null;
            case "write_coils":
                client.writeMultipleCoils(unit,
                        new WriteMultipleCoilsRequest(address, values.length, packed(values)));
                return null;
            case "write_registers":
                client.writeMultipleRegisters(unit,
                        new WriteMultipleRegistersRequest(address, values.length, bytes(values)));
                return null;
            case "mask_write":
                client.maskWriteRegister(unit, new MaskWriteRegisterRequest(
                        address, asked.number("and"), asked.number("or")));
                return null;
            case "read_write":
                return words(client.readWriteMultipleRegisters(unit,
                        new ReadWriteMultipleRegistersRequest(asked.number("read_address"), count,
                                address, values.length, bytes(values))).registers());
            default:
                throw new IllegalArgumentException("no call " + asked.call);
        }
    }

    private static int[] bits(byte[] packed, int count) {
        int[] values = new int[count];
        for (int at = 0; at < count; at++) {
            values[at] = packed[at / 8] >> (at % 8) & 1;
        }
        return values;
    }

    private static byte[] packed(int[] bits) {
        byte[] packed = new byte[(bits.length + 7) / 8];
        for (int at = 0; at < bits.length; at++) {
            packed[at / 8] |= (byte) (bits[at] << (at % 8));
        }
        return packed;
    }

    private static int[] words(byte[] bytes) {
        int[] values = new int[bytes.length / 2];
        for (int at = 0; at < values.length; at++) {
            values[at] = (bytes[2 * at] & 0xFF) << 8 | bytes[2 * at + 1] & 0xFF;
        }
        return values;
    }

    private static byte[] bytes(int... words) {
        byte[] bytes = new byte[words.length * 2];
        for (int at = 0; at < words.length; at++) {
            bytes[2 * at] = (byte) (words[at] >> 8);
            bytes[2 * at + 1] = (byte) words[at];
        }
        return bytes;
    }

    private static void runServer(String scheme) throws Exception {
        ProcessImage image = new ProcessImage();
        image.with(areas -> {
            for (int at = 0; at < 1000; at++) {
                int value = at;
                areas.writeDiscreteInputs(inputs -> inputs.put(value, value % 3 == 0));
                areas.writeInputRegisters(inputs -> inputs.put(value, bytes(value)));
            }
        });
        ReadWriteModbusServices services = new ReadWriteModbusServices() {
            @Override
            protected Optional<ProcessImage> getProcessImage(int unit) {
                return unit == 1 ? Optional.of(image) : Optional.empty();
            }
        };
        int port = JsonLines.freePort();
        ModbusServer server = scheme.equals("tcp")
                ? ModbusTcpServer.create(NettyTcpServerTransport.create(at -> {
                    at.bindAddress = "127.0.0.1";
                    at.port = port;
                }), services)
                : ModbusRtuServer.create(NettyRtuServerTransport.create(at -> {
                    at.bindAddress = "127.0.0.1";
                    at.port = port;
                }), services);
        server.start();
        JsonLines.served(port);
    }
}
