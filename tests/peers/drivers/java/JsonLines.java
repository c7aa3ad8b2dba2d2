import java.io.BufferedReader;
import java.io.IOException;
import java.io.InputStreamReader;
import java.net.InetAddress;
import java.net.ServerSocket;
import java.util.Arrays;
import java.util.Map;
import java.util.regex.Matcher;
import java.util.regex.Pattern;
import java.util.stream.Collectors;

/** The protocol of drivers in Java: operations as JSON lines in, a result for each out. */
final class JsonLines {
    private static final Pattern MEMBER =
            Pattern.compile("\"(\\w+)\":\\s*(?:\"([^\"]*)\"|\\[([^\\]]*)\\]|(\\d+))");

    private JsonLines() {}

    /** The server answered with an exception code. */
    static final class Answered extends Exception {
        final int code;

        Answered(int code) {
            this.code = code;
        }
    }

    /** One operation: a call, and numbers by their names. */
    static final class Operation {
        final String call;
        final int[] values;
        private final String line;

        Operation(String line) {
            this.line = line;
            this.call = member("call", 2);
            String list = member("values", 3);
            this.values = list == null || list.isBlank() ? new int[0]
                    : Arrays.stream(list.split(",")).map(String::trim)
                            .mapToInt(Integer::parseInt).toArray();
        }

        int number(String name) {
            String found = member(name, 4);
            return found == null ? 0 : Integer.parseInt(found);
        }

        private String member(String name, int group) {
            Matcher members = MEMBER.matcher(line);
            while (members.find()) {
                if (members.group(1).equals(name)) {
                    return members.group(group);
                }
            }
            return null;
        }
    }

    interface Execute {
        Object execute(Operation operation) throws Exception;
    }

    static void answerAll(Execute client) throws IOException {
        BufferedReader lines = new BufferedReader(new InputStreamReader(System.in));
        for (String line = lines.readLine(); line != null; line = lines.readLine()) {
            System.out.println(result(client, new Operation(line)));
        }
        System.exit(0);
    }

    private static String result(Execute client, Operation operation) {
        try {
            return "{\"value\":" + json(client.execute(operation)) + "}";
        } catch (Answered answer) {
            return "{\"exception\":" + answer.code + "}";
        } catch (Exception error) {
            return "{\"error\":" + json(error.toString()) + "}";
        }
    }

    private static String json(Object value) {
        if (value instanceof int[] numbers) {
            return Arrays.toString(numbers);
        }
        if (value instanceof Map<?, ?> members) {
            return members.entrySet().stream()
                    .map(each -> json(each.getKey().toString()) + ":" + json(each.getValue()))
                    .collect(Collectors.joining(",", "{", "}"));
        }
        if (value instanceof String text) {
            return "\"" + text.replaceAll("[\"\\\\\\p{Cntrl}]", "?") + "\"";
        }
        return String.valueOf(value);
    }

    /** Prints the port of a server, and lets it serve until standard input ends. */
    static void served(int port) throws IOException {
        System.out.println(port);
        System.in.read();
        System.exit(0);
    }

    /** A port that was free: the servers do not tell theirs. */
    static int freePort() throws IOException {
        try (ServerSocket free = new ServerSocket(0, 1, InetAddress.getLoopbackAddress())) {
            return free.getLocalPort();
        }
    }
}
