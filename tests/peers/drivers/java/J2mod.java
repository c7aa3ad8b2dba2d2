import com.ghgande.j2mod.modbus.ModbusSlaveException;
import com.ghgande.j2mod.modbus.facade.AbstractModbusMaster;
import com.ghgande.j2mod.modbus.facade.ModbusTCPMaster;
import com.ghgande.j2mod.modbus.facade.ModbusUDPMaster;
import com.ghgande.j2mod.modbus.io.ModbusTransaction;
import com.ghgande.j2mod.modbus.msg.ModbusRequest;
import com.ghgande.j2mod.modbus.msg.ModbusResponse;
import com.ghgande.j2mod.modbus.msg.ReadMEIRequest;
import com.ghgande.j2mod.modbus.msg.ReadMEIResponse;
import com.ghgande.j2mod.modbus.msg.ReadWriteMultipleRequest;
import com.ghgande.j2mod.modbus.msg.ReadWriteMultipleResponse;
import com.ghgande.j2mod.modbus.procimg.InputRegister;
import com.ghgande.j2mod.modbus.procimg.Register;
import com.ghgande.j2mod.modbus.procimg.SimpleDigitalIn;
import com.ghgande.j2mod.modbus.procimg.SimpleDigitalOut;
import com.ghgande.j2mod.modbus.procimg.SimpleInputRegister;
import com.ghgande.j2mod.modbus.procimg.SimpleProcessImage;
import com.ghgande.j2mod.modbus.procimg.SimpleRegister;
import com.ghgande.j2mod.modbus.slave.ModbusSlave;
import com.ghgande.j2mod.modbus.slave.ModbusSlaveFactory;
import com.ghgande.j2mod.modbus.util.BitVector;
import java.net.InetAddress;
import java.net.URI;
import java.util.Arrays;
import java.util.Map;
import java.util.TreeMap;

/** The driver of j2mod: a client and a server over TCP, UDP and RTU over TCP. */
public final class J2mod {
    private static final int TIMEOUT = 10000;

    private J2mod() {}

    public static void main(String[] words) throws Exception {
        URI url = URI.create(words[1]);
        if (words[0].equals("client")) {
            runClient(url, Integer.parseInt(words[2]));
        } else {
            runServer(url.getScheme());
        }
    }

    private static AbstractModbusMaster opened(URI url) {
        String host = url.getHost();
        return switch (url.getScheme()) {
            case "tcp" -> new ModbusTCPMaster(host, url.getPort(), TIMEOUT, false, false);
            case "rtu+tcp" -> new ModbusTCPMaster(host, url.getPort(), TIMEOUT, false, true);
            case "udp" -> new ModbusUDPMaster(host, url.getPort(), TIMEOUT);
            default -> throw new IllegalArgumentException(url.toString());
        };
    }

    private static void runClient(URI url, int unit) throws Exception {
        AbstractModbusMaster client = opened(url);
        client.setRetries(0);
        client.connect();
        JsonLines.answerAll(operation -> {
            try {
                return call(client, unit, operation);
            } catch (ModbusSlaveException answer) {
                throw new JsonLines.Answered(answer.getType());
            }
        });
    }

    private static Object call(AbstractModbusMaster client, int unit, JsonLines.Operation asked)
            throws Exception {
        int address = asked.number("address");
        int count = asked.number("count");
        int value = asked.number("value");
        switch (asked.call) {
            case "read_coils":
                return numbers(client.readCoils(unit, address, count), count);
            case "read_discrete_inputs":
                return numbers(client.readInputDiscretes(unit, address, count), count);
            case "read_holding_registers":
                return numbers(client.readMultipleRegisters(unit, address, count));
            case "read_input_registers":
                return numbers(client.readInputRegisters(unit, address, count));
            case "write_coil":
                client.writeCoil(unit, address, value == 1);
                return null;
            case "write_register":
                client.writeSingleRegister(unit, address, new SimpleRegister(value));
                return null;
            case "write_coils":
                BitVector bits = new BitVector(asked.values.length);
                for (int at = 0; at < asked.values.length; at++) {
                    bits.setBit(at, asked.values[at] == 1);
                }
                client.writeMultipleCoils(unit, address, bits);
                return null;
            case "write_registers":
                client.writeMultipleRegisters(unit, address, registers(asked.values));
                return null;
            case "mask_write":
                client.maskWriteRegister(unit, address, asked.number("and"), asked.number("or"));
                return null;
            case "read_write":
                ReadWriteMultipleRequest both = new ReadWriteMultipleRequest(
                        unit, asked.number("read_address"), count, address, asked.values.length);
                both.setRegisters(registers(asked.values));
                return numbers(((ReadWriteMultipleResponse) send(client, unit, both)).getRegisters());
            case "identify":
                return identify((ReadMEIResponse) send(client, unit,
                        new ReadMEIRequest(asked.number("code"), asked.number("object"))));
            default:
                throw new IllegalArgumentException("no call " + asked.call);
        }
    }

    private static ModbusResponse send(AbstractModbusMaster client, int unit, ModbusRequest request)
            throws Exception {
        request.setUnitID(unit);
        ModbusTransaction transaction = client.getTransport().createTransaction();
        transaction.setRequest(request);
        transaction.setRetries(0);
        transaction.execute();
        return transaction.getResponse();
    }

    private static Map<Integer, String> identify(ReadMEIResponse reply) {
        Map<Integer, String> objects = new TreeMap<>();
        for (int at = 0; at < reply.getFieldCount(); at++) {
            objects.put(reply.getFieldId(at), reply.getField(at));
        }
        return objects;
    }

    private static int[] numbers(BitVector bits, int count) {
        int[] values = new int[count];
        for (int at = 0; at < count; at++) {
            values[at] = bits.getBit(at) ? 1 : 0;
        }
        return values;
    }

    private static int[] numbers(InputRegister[] registers) {
        return Arrays.stream(registers).mapToInt(InputRegister::toUnsignedShort).toArray();
    }

    private static Register[] registers(int[] values) {
        return Arrays.stream(values).mapToObj(SimpleRegister::new).toArray(Register[]::new);
    }

    private static void runServer(String scheme) throws Exception {
        SimpleProcessImage image = new SimpleProcessImage(1);
        for (int at = 0; at < 1000; at++) {
            image.addDigitalOut(new SimpleDigitalOut(false));
            image.addDigitalIn(new SimpleDigitalIn(at % 3 == 0));
            image.addRegister(new SimpleRegister(0));
            image.addInputRegister(new SimpleInputRegister(at));
        }
        int port = JsonLines.freePort();
        InetAddress loopback = InetAddress.getLoopbackAddress();
        ModbusSlave server = scheme.equals("udp")
                ? ModbusSlaveFactory.createUDPSlave(loopback, port)
                : ModbusSlaveFactory.createTCPSlave(loopback, port, 2, scheme.equals("rtu+tcp"));
        server.addProcessImage(1, image);
        server.open();
        JsonLines.served(port);
    }
}
