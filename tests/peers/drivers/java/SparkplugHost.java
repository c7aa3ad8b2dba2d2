import java.io.BufferedReader;
import java.io.InputStreamReader;
import java.util.Arrays;
import java.util.Date;
import java.util.List;
import org.eclipse.tahu.host.HostApplication;
import org.eclipse.tahu.host.api.HostApplicationEventHandler;
import org.eclipse.tahu.message.SparkplugBPayloadDecoder;
import org.eclipse.tahu.message.model.DeviceDescriptor;
import org.eclipse.tahu.message.model.EdgeNodeDescriptor;
import org.eclipse.tahu.message.model.Message;
import org.eclipse.tahu.message.model.MessageType;
import org.eclipse.tahu.message.model.Metric;
import org.eclipse.tahu.message.model.Metric.MetricBuilder;
import org.eclipse.tahu.message.model.MetricDataType;
import org.eclipse.tahu.message.model.PropertyValue;
import org.eclipse.tahu.message.model.SparkplugBPayload.SparkplugBPayloadBuilder;
import org.eclipse.tahu.message.model.SparkplugDescriptor;
import org.eclipse.tahu.message.model.Topic;
import org.eclipse.tahu.model.MqttServerDefinition;
import org.eclipse.tahu.mqtt.MqttClientId;
import org.eclipse.tahu.mqtt.MqttServerName;
import org.eclipse.tahu.mqtt.MqttServerUrl;

/**
 * A Sparkplug host application: SparkplugHost BROKER HOST_ID. Prints what it learns as JSON lines, and
 * executes commands from standard input until it ends:
 *
 * <pre>
 * write GROUP NODE DEVICE METRIC TYPE VALUE
 * rebirth GROUP NODE
 * </pre>
 */
final class SparkplugHost implements HostApplicationEventHandler {
    public static void main(String[] arguments) throws Exception {
        MqttServerDefinition broker = new MqttServerDefinition(new MqttServerName("broker"),
                new MqttClientId("host", true), new MqttServerUrl(arguments[0]), null, null, 30, null);
        HostApplication host = new HostApplication(new SparkplugHost(), arguments[1],
                List.of("spBv1.0/#"), List.of(broker), null, new SparkplugBPayloadDecoder(), true);
        host.start(true);
        BufferedReader lines = new BufferedReader(new InputStreamReader(System.in));
        for (String line = lines.readLine(); line != null; line = lines.readLine()) {
            String[] words = line.split(" ");
            if (words[0].equals("write")) {
                Topic topic = new Topic("spBv1.0", words[1], words[2], words[3], MessageType.DCMD);
                Object type = MetricDataType.class.getField(words[5]).get(null);
                command(host, topic, words[4], (MetricDataType) type, value(words[5], words[6]));
            } else {
                Topic topic = new Topic("spBv1.0", words[1], words[2], MessageType.NCMD);
                command(host, topic, "Node Control/Rebirth", MetricDataType.Boolean, true);
            }
        }
        host.shutdown();
        System.exit(0);
    }

    private static void command(
            HostApplication host, Topic topic, String name, MetricDataType type, Object value)
            throws Exception {
        Metric metric = new MetricBuilder(name, type, value).createMetric();
        host.publishCommand(topic,
                new SparkplugBPayloadBuilder().setTimestamp(new Date()).addMetric(metric).createPayload());
    }

    private static Object value(String type, String text) {
        return switch (type) {
            case "Boolean" -> Boolean.valueOf(text);
            case "Int16" -> Short.valueOf(text);
            case "Int32", "UInt16" -> Integer.valueOf(text);
            case "Int64", "UInt32" -> Long.valueOf(text);
            case "Float" -> Float.valueOf(text);
            case "Double" -> Double.valueOf(text);
            default -> text;
        };
    }

    private static synchronized void tell(String event, SparkplugDescriptor of, String more) {
        System.out.println("{\"event\":" + quoted(event) + ",\"of\":"
                + quoted(of == null ? "" : of.getDescriptorString()) + more + "}");
    }

    private static void tell(String event, SparkplugDescriptor of, Metric metric) {
        Object value = metric.getValue();
        PropertyValue quality =
                metric.getProperties() == null ? null : metric.getProperties().get("Quality");
        tell(event, of, ",\"name\":" + quoted(metric.getName())
                + ",\"type\":" + quoted(String.valueOf(metric.getDataType()))
                + ",\"value\":" + json(value)
                + ",\"historical\":" + Boolean.TRUE.equals(metric.isHistorical())
                + ",\"time\":" + (metric.getTimestamp() == null ? 0 : metric.getTimestamp().getTime())
                + ",\"quality\":" + (quality == null ? "null" : quality.getValue()));
    }

    private static String json(Object value) {
        if (value == null || value instanceof Number || value instanceof Boolean) {
            return String.valueOf(value);
        }
        return value instanceof Object[] items
                ? "[" + String.join(",", Arrays.stream(items).map(SparkplugHost::json).toList()) + "]"
                : quoted(value.toString());
    }

    private static String quoted(String text) {
        return "\"" + text.replaceAll("[\"\\\\\\p{Cntrl}]", "?") + "\"";
    }

    @Override
    public void onConnect() {
        tell("connected", null, "");
    }

    @Override
    public void onDisconnect() {}

    @Override
    public void onMessage(SparkplugDescriptor of, Message message) {}

    @Override
    public void onNodeBirthArrived(EdgeNodeDescriptor of, Message message) {}

    @Override
    public void onNodeBirthComplete(EdgeNodeDescriptor of) {
        tell("node_birth", of, "");
    }

    @Override
    public void onNodeDataArrived(EdgeNodeDescriptor of, Message message) {}

    @Override
    public void onNodeDataComplete(EdgeNodeDescriptor of) {}

    @Override
    public void onNodeDeath(EdgeNodeDescriptor of, Message message) {
        tell("node_death", of, "");
    }

    @Override
    public void onNodeDeathComplete(EdgeNodeDescriptor of) {}

    @Override
    public void onDeviceBirthArrived(DeviceDescriptor of, Message message) {}

    @Override
    public void onDeviceBirthComplete(DeviceDescriptor of) {
        tell("device_birth", of, "");
    }

    @Override
    public void onDeviceDataArrived(DeviceDescriptor of, Message message) {}

    @Override
    public void onDeviceDataComplete(DeviceDescriptor of) {}

    @Override
    public void onDeviceDeath(DeviceDescriptor of, Message message) {
        tell("device_death", of, "");
    }

    @Override
    public void onDeviceDeathComplete(DeviceDescriptor of) {}

    @Override
    public void onBirthMetric(SparkplugDescriptor of, Metric metric) {
        tell("birth_metric", of, metric);
    }

    @Override
    public void onDataMetric(SparkplugDescriptor of, Metric metric) {
        tell("data_metric", of, metric);
    }

    @Override
    public void onStale(SparkplugDescriptor of, Metric metric) {
        tell("stale", of, ",\"name\":" + quoted(metric.getName()));
    }
}
