// A load generator on the real client library of ROS 2 (rcl and the rmw that its environment has), without Python in the path of a
// message. run.py loads it, and finds the shared libraries for it. The command line and the JSON lines are those of ../README.md.
#include <inttypes.h>
#include <poll.h>
#include <signal.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <rosidl_runtime_c/primitives_sequence_functions.h>
#include <std_msgs/msg/u_int8_multi_array.h>

enum { EXIT_FINE = 0, EXIT_WRONG = 1, EXIT_USAGE = 2, EXIT_INCOMPLETE = 3 };

// The first bytes of a message: sequence number, time of writing in ns, and the sum of all bytes behind.
enum { HEAD_BYTES = 24 };
// The longest wait of a publisher for acknowledgements.
#define ACKNOWLEDGED_WAIT_NS ((int64_t)20 * 1000000000)
// Most latencies kept. Beyond it, each replaces another at random.
enum { LATENCIES_MAX = 100000 };
// Sequence numbers for which repetitions are detected.
#define SEQ_MAX ((uint64_t)64 << 20)

typedef struct {
    const char *role, *topic, *back, *node;
    uint64_t count, size, last;
    double rate, timeout, linger, hold, begin;
    long depth;
    bool best_effort, transient_local, wait_go, wait_stop, verbose, insist;
    unsigned wait_matched;
} Options;

static Options options = {.role = "", .topic = "/load", .back = "/load_back", .node = "load", .size = 1000, .rate = 10,
                          .timeout = 60, .depth = 10, .wait_matched = 1};
static volatile sig_atomic_t stopped;

static rcl_context_t context;
static rcl_node_t node;

static void stop(int signal) {
    (void)signal;
    stopped = 1;
}

static int64_t monotonic_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static int64_t wall_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_REALTIME, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static void check(rcl_ret_t ret, const char *of) {
    if (ret != RCL_RET_OK) {
        fprintf(stderr, "%s: %s\n", of, rcl_get_error_string().str);
        exit(EXIT_USAGE);
    }
}

static bool is_over(int64_t deadline) { return stopped || monotonic_ns() >= deadline; }

static rmw_qos_profile_t qos(void) {
    rmw_qos_profile_t profile = rmw_qos_profile_default;
    profile.history = options.depth == 0 ? RMW_QOS_POLICY_HISTORY_KEEP_ALL : RMW_QOS_POLICY_HISTORY_KEEP_LAST;
    profile.depth = (size_t)options.depth;
    if (options.best_effort) profile.reliability = RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT;
    if (options.transient_local) profile.durability = RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL;
    return profile;
}

static const rosidl_message_type_support_t *type(void) {
    return ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, UInt8MultiArray);
}

static rcl_publisher_t publisher_of(const char *topic) {
    rcl_publisher_t publisher = rcl_get_zero_initialized_publisher();
    rcl_publisher_options_t how = rcl_publisher_get_default_options();
    how.qos = qos();
    check(rcl_publisher_init(&publisher, &node, type(), topic, &how), "publisher");
    return publisher;
}

static rcl_subscription_t subscription_of(const char *topic) {
    rcl_subscription_t subscription = rcl_get_zero_initialized_subscription();
    rcl_subscription_options_t how = rcl_subscription_get_default_options();
    how.qos = qos();
    check(rcl_subscription_init(&subscription, &node, type(), topic, &how), "subscription");
    return subscription;
}

static uint64_t sum_of(const uint8_t *data, size_t bytes) {
    // FNV-1a by words, which reads a whole message at the speed of memory.
    uint64_t sum = 0xcbf29ce484222325;
    for (; bytes >= 8; data += 8, bytes -= 8) {
        uint64_t word;
        memcpy(&word, data, 8);
        sum = (sum ^ word) * 0x100000001b3;
    }
    for (; bytes > 0; data++, bytes--) sum = (sum ^ *data) * 0x100000001b3;
    return sum;
}

static void fill(std_msgs__msg__UInt8MultiArray *message, uint64_t seq) {
    uint8_t *data = message->data.data;
    size_t bytes = message->data.size;
    uint64_t head[3] = {seq, (uint64_t)wall_ns(), 0};
    // A stamp that differs from message to message, at the beginning, in the middle and at the end of the content.
    if (bytes > HEAD_BYTES + 24) {
        memcpy(data + HEAD_BYTES, &seq, 8);
        memcpy(data + bytes / 2, &seq, 8);
        memcpy(data + bytes - 8, &seq, 8);
    }
    head[2] = sum_of(data + HEAD_BYTES, bytes - HEAD_BYTES) ^ seq;
    memcpy(data, head, HEAD_BYTES);
}

static void make(std_msgs__msg__UInt8MultiArray *message, size_t bytes) {
    // The function below leaves numbers as they are.
    memset(message, 0, sizeof *message);
    std_msgs__msg__UInt8MultiArray__init(message);
    rosidl_runtime_c__uint8__Sequence__init(&message->data, bytes);
    for (size_t i = 0; i < bytes; i++) message->data.data[i] = (uint8_t)(i * 167 + (i >> 8));
}

static bool read_head(const std_msgs__msg__UInt8MultiArray *message, uint64_t *seq, int64_t *written_ns) {
    if (message->data.size < HEAD_BYTES) return false;
    uint64_t head[3];
    memcpy(head, message->data.data, HEAD_BYTES);
    *seq = head[0];
    *written_ns = (int64_t)head[1];
    return head[2] == (sum_of(message->data.data + HEAD_BYTES, message->data.size - HEAD_BYTES) ^ head[0]);
}

static void pause_for_ns(int64_t ns) {
    if (ns <= 0) return;
    struct timespec t = {ns / 1000000000, ns % 1000000000};
    nanosleep(&t, NULL);
}

// Returns true if a line, or the end, came on standard input within some milliseconds.
static bool line_came(int wait_ms) {
    struct pollfd input = {STDIN_FILENO, POLLIN, 0};
    if (poll(&input, 1, wait_ms) <= 0) return false;
    char c;
    while (read(STDIN_FILENO, &c, 1) == 1 && c != '\n') {}
    return true;
}

static size_t matched_of(const rcl_publisher_t *publisher) {
    size_t count = 0;
    check(rcl_publisher_get_subscription_count(publisher, &count), "matched");
    return count;
}

static void say_matched(size_t now, size_t *before) {
    if (now != *before) printf("{\"event\": \"matched\", \"count\": %zu}\n", now);
    *before = now;
}

static int publish(int64_t deadline) {
    rcl_publisher_t publisher = publisher_of(options.topic);
    std_msgs__msg__UInt8MultiArray message;
    make(&message, options.size);
    printf("{\"event\": \"ready\"}\n");
    size_t matched = 0;
    while (matched < options.wait_matched && !is_over(deadline)) {
        say_matched(matched_of(&publisher), &matched);
        pause_for_ns(1000000);
    }
    while (options.wait_go && !line_came(10) && !is_over(deadline)) say_matched(matched_of(&publisher), &matched);

    int64_t begun = monotonic_ns(), next = begun;
    int64_t interval = options.rate > 0 ? (int64_t)(1e9 / options.rate) : 0;
    uint64_t seq = 0, refused = 0;
    for (; (options.count == 0 || seq < options.count) && !is_over(deadline); seq++) {
        if (options.wait_stop && line_came(0)) break;
        fill(&message, seq);
        while (rcl_publish(&publisher, &message, NULL) != RCL_RET_OK) {
            refused++;
            rcl_reset_error();
            if (!options.insist || is_over(deadline)) break;
        }
        if (options.verbose) printf("{\"event\": \"sent\", \"seq\": %" PRIu64 "}\n", seq);
        if (seq == 0 && options.begin > 0) {
            pause_for_ns((int64_t)(options.begin * 1e9));
            next = monotonic_ns();
        }
        next += interval;
        int64_t early = next - monotonic_ns();
        // A delayed publisher catches up, as a timer does.
        if (interval > 0 && early > 0) pause_for_ns(early);
    }
    double seconds = (double)(monotonic_ns() - begun) / 1e9;
    printf("{\"event\": \"all_sent\", \"sent\": %" PRIu64 "}\n", seq);
    bool acknowledged =
        options.best_effort || rcl_publisher_wait_for_all_acked(&publisher, ACKNOWLEDGED_WAIT_NS) == RCL_RET_OK;
    int64_t until = monotonic_ns() + (int64_t)(options.hold * 1e9);
    while (monotonic_ns() < until && !is_over(deadline)) pause_for_ns(10000000);
    printf("{\"event\": \"summary\", \"role\": \"pub\", \"sent\": %" PRIu64 ", \"refused\": %" PRIu64
           ", \"seconds\": %.4f, \"acknowledged\": %s, \"matched\": %zu}\n",
           seq, refused, seconds, acknowledged ? "true" : "false", matched_of(&publisher));
    check(rcl_publisher_fini(&publisher, &node), "publisher");
    return options.count != 0 && seq < options.count ? EXIT_INCOMPLETE : EXIT_FINE;
}

typedef struct {
    uint8_t *seen;
    uint64_t received, duplicated, altered, reordered, first, last, latencies;
    int64_t first_ns, last_ns;
    int64_t *latency_ns;
} Tally;

static int by_size(const void *a, const void *b) {
    int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

static void note_latency(Tally *tally, int64_t ns) {
    uint64_t at = tally->latencies++;
    if (at >= LATENCIES_MAX) at = (uint64_t)random() % tally->latencies;
    if (at < LATENCIES_MAX) tally->latency_ns[at] = ns;
}

static void note(Tally *tally, const std_msgs__msg__UInt8MultiArray *message) {
    uint64_t seq = 0;
    int64_t written_ns = 0, now = wall_ns();
    bool is_good = read_head(message, &seq, &written_ns) && seq < SEQ_MAX;
    if (options.verbose || !is_good)
        printf("{\"event\": \"received\", \"seq\": %" PRIu64 ", \"ok\": %s}\n", seq, is_good ? "true" : "false");
    if (!is_good) {
        tally->altered++;
        return;
    }
    if (tally->seen[seq >> 3] >> (seq & 7) & 1) {
        tally->duplicated++;
        return;
    }
    tally->seen[seq >> 3] |= (uint8_t)(1 << (seq & 7));
    if (tally->received == 0) tally->first = tally->last = seq, tally->first_ns = monotonic_ns();
    if (seq < tally->last) tally->reordered++;
    if (seq < tally->first) tally->first = seq;
    if (seq > tally->last) tally->last = seq;
    tally->received++;
    tally->last_ns = monotonic_ns();
    note_latency(tally, now - written_ns);
}

static void report(Tally *tally, const char *role, uint64_t sent) {
    uint64_t n = tally->latencies < LATENCIES_MAX ? tally->latencies : LATENCIES_MAX;
    qsort(tally->latency_ns, n, sizeof(int64_t), by_size);
    int64_t p50 = n ? tally->latency_ns[n / 2] : 0, p99 = n ? tally->latency_ns[n * 99 / 100] : 0,
            max = n ? tally->latency_ns[n - 1] : 0;
    uint64_t range = tally->received ? tally->last - tally->first + 1 : 0;
    printf("{\"event\": \"summary\", \"role\": \"%s\", \"sent\": %" PRIu64 ", \"received\": %" PRIu64 ", \"first\": %" PRIu64
           ", \"last\": %" PRIu64 ", \"lost\": %" PRIu64 ", \"duplicated\": %" PRIu64 ", \"altered\": %" PRIu64
           ", \"reordered\": %" PRIu64 ", \"seconds\": %.4f, \"latency_us\": {\"p50\": %.1f, \"p99\": %.1f, \"max\": %.1f}}\n",
           role, sent, tally->received, tally->first, tally->last, range - tally->received, tally->duplicated, tally->altered,
           tally->reordered, (double)(tally->last_ns - tally->first_ns) / 1e9, p50 / 1e3, p99 / 1e3, max / 1e3);
}

static rcl_wait_set_t waiting_for(void) {
    rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
    check(rcl_wait_set_init(&set, 1, 0, 0, 0, 0, 0, &context, rcl_get_default_allocator()), "wait set");
    return set;
}

// Waits for a message until the time-out.
static void wait_for(rcl_wait_set_t *set, const rcl_subscription_t *subscription, int64_t ns) {
    check(rcl_wait_set_clear(set), "wait set");
    check(rcl_wait_set_add_subscription(set, subscription, NULL), "wait set");
    rcl_ret_t ret = rcl_wait(set, ns);
    if (ret != RCL_RET_OK && ret != RCL_RET_TIMEOUT) check(ret, "wait");
}

static bool take(rcl_subscription_t *subscription, std_msgs__msg__UInt8MultiArray *message) {
    rmw_message_info_t info;
    rcl_ret_t ret = rcl_take(subscription, message, &info, NULL);
    if (ret != RCL_RET_OK && ret != RCL_RET_SUBSCRIPTION_TAKE_FAILED) check(ret, "take");
    if (ret != RCL_RET_OK) rcl_reset_error();
    return ret == RCL_RET_OK;
}

static Tally tally_of_none(void) {
    Tally tally = {.seen = calloc(1, SEQ_MAX / 8), .latency_ns = calloc(LATENCIES_MAX, sizeof(int64_t))};
    if (!tally.seen || !tally.latency_ns) exit(EXIT_USAGE);
    return tally;
}

// Returns true once so many messages have come, or the last one.
static bool is_enough(const Tally *tally) {
    if (options.last != 0) return tally->received > 0 && tally->last + 1 >= options.last;
    return options.count != 0 && tally->received >= options.count;
}

// Subscribes to one topic. As `echo`, publishes each message on another.
static int subscribe(int64_t deadline, bool echoes) {
    rcl_publisher_t back = rcl_get_zero_initialized_publisher();
    if (echoes) back = publisher_of(options.back);
    rcl_subscription_t subscription = subscription_of(options.topic);
    rcl_wait_set_t set = waiting_for();
    Tally tally = tally_of_none();
    std_msgs__msg__UInt8MultiArray message;
    std_msgs__msg__UInt8MultiArray__init(&message);
    printf("{\"event\": \"ready\"}\n");
    size_t matched = 0;
    int64_t last_look = 0;
    while (!is_enough(&tally) && !is_over(deadline)) {
        if (monotonic_ns() - last_look > 10000000) {
            size_t now = 0;
            check(rcl_subscription_get_publisher_count(&subscription, &now), "matched");
            say_matched(now, &matched);
            last_look = monotonic_ns();
        }
        wait_for(&set, &subscription, 10000000);
        while (!stopped && take(&subscription, &message)) {
            if (echoes) check(rcl_publish(&back, &message, NULL), "publish");
            note(&tally, &message);
        }
    }
    int64_t until = monotonic_ns() + (int64_t)(options.linger * 1e9);
    while (monotonic_ns() < until && !stopped) {
        wait_for(&set, &subscription, 10000000);
        while (take(&subscription, &message)) note(&tally, &message);
    }
    report(&tally, echoes ? "echo" : "sub", 0);
    check(rcl_subscription_fini(&subscription, &node), "subscription");
    if (echoes) check(rcl_publisher_fini(&back, &node), "publisher");
    if (tally.altered || tally.duplicated) return EXIT_WRONG;
    return (options.count != 0 || options.last != 0) && !is_enough(&tally) ? EXIT_INCOMPLETE : EXIT_FINE;
}

// Sends a message, waits for its echo, and sends the next; the latency is that of the round trip.
static int ping(int64_t deadline) {
    rcl_publisher_t publisher = publisher_of(options.topic);
    rcl_subscription_t subscription = subscription_of(options.back);
    rcl_wait_set_t set = waiting_for();
    Tally tally = tally_of_none();
    std_msgs__msg__UInt8MultiArray message, echo;
    make(&message, options.size);
    std_msgs__msg__UInt8MultiArray__init(&echo);
    printf("{\"event\": \"ready\"}\n");
    size_t there = 0, here = 0;
    while ((there < 1 || here < 1) && !is_over(deadline)) {
        say_matched(matched_of(&publisher), &there);
        check(rcl_subscription_get_publisher_count(&subscription, &here), "matched");
        pause_for_ns(1000000);
    }
    while (options.wait_go && !line_came(10) && !is_over(deadline)) {}
    pause_for_ns((int64_t)(options.begin * 1e9));
    uint64_t seq = 0;
    while ((options.count == 0 || seq < options.count) && !is_over(deadline)) {
        int64_t begun = monotonic_ns();
        fill(&message, seq);
        check(rcl_publish(&publisher, &message, NULL), "publish");
        bool is_back = false;
        // The first message may be lost if one end is matched before the other.
        int64_t patience = begun + 1000000000;
        while (!is_back && !is_over(patience)) {
            wait_for(&set, &subscription, 100000000);
            while (!is_back && take(&subscription, &echo)) {
                uint64_t which = 0;
                int64_t written_ns = 0;
                if (!read_head(&echo, &which, &written_ns)) tally.altered++;
                is_back = which == seq;
            }
        }
        if (is_back) {
            if (tally.received++ == 0) tally.first_ns = begun, tally.first = seq;
            tally.last_ns = monotonic_ns();
            tally.last = seq;
            note_latency(&tally, tally.last_ns - begun);
        }
        seq++;
        if (options.rate > 0) pause_for_ns((int64_t)(1e9 / options.rate) - (monotonic_ns() - begun));
    }
    report(&tally, "ping", seq);
    check(rcl_subscription_fini(&subscription, &node), "subscription");
    check(rcl_publisher_fini(&publisher, &node), "publisher");
    return tally.altered ? EXIT_WRONG : tally.received == 0 ? EXIT_INCOMPLETE : EXIT_FINE;
}

static const char *value_of(int argc, char **argv, int *at) {
    if (*at + 1 >= argc) {
        fprintf(stderr, "%s needs a value\n", argv[*at]);
        exit(EXIT_USAGE);
    }
    return argv[++*at];
}

static void read_options(int argc, char **argv) {
    if (argc > 1) options.role = argv[1];
    for (int i = 2; i < argc; i++) {
        const char *name = argv[i];
#define IS(text) (strcmp(name, text) == 0)
#define VALUE value_of(argc, argv, &i)
        if (IS("--topic")) options.topic = VALUE;
        else if (IS("--back")) options.back = VALUE;
        else if (IS("--node")) options.node = VALUE;
        else if (IS("--count")) options.count = strtoull(VALUE, NULL, 10);
        else if (IS("--last")) options.last = strtoull(VALUE, NULL, 10);
        else if (IS("--size")) options.size = strtoull(VALUE, NULL, 10);
        else if (IS("--rate")) options.rate = strtod(VALUE, NULL);
        else if (IS("--timeout")) options.timeout = strtod(VALUE, NULL);
        else if (IS("--linger")) options.linger = strtod(VALUE, NULL);
        else if (IS("--hold")) options.hold = strtod(VALUE, NULL);
        else if (IS("--begin")) options.begin = strtod(VALUE, NULL);
        else if (IS("--depth")) options.depth = strtol(VALUE, NULL, 10);
        else if (IS("--wait-matched")) options.wait_matched = (unsigned)strtoul(VALUE, NULL, 10);
        else if (IS("--reliable")) options.best_effort = false;
        else if (IS("--best-effort")) options.best_effort = true;
        else if (IS("--transient-local")) options.transient_local = true;
        else if (IS("--wait-go")) options.wait_go = true;
        else if (IS("--wait-stop")) options.wait_stop = true;
        else if (IS("--insist")) options.insist = true;
        else if (IS("--verbose")) options.verbose = true;
        else {
            fprintf(stderr, "unknown option %s\n", name);
            exit(EXIT_USAGE);
        }
    }
    if (options.size < HEAD_BYTES) options.size = HEAD_BYTES;
}

int load_main(int argc, char **argv) {
    read_options(argc, argv);
    setvbuf(stdout, NULL, _IOLBF, 0);
    int64_t deadline = monotonic_ns() + (int64_t)(options.timeout * 1e9);

    rcl_init_options_t init = rcl_get_zero_initialized_init_options();
    check(rcl_init_options_init(&init, rcl_get_default_allocator()), "options");
    context = rcl_get_zero_initialized_context();
    check(rcl_init(0, NULL, &init, &context), "init");
    node = rcl_get_zero_initialized_node();
    rcl_node_options_t how = rcl_node_get_default_options();
    check(rcl_node_init(&node, options.node, "", &context, &how), "node");
    struct sigaction action = {.sa_handler = stop};
    sigaction(SIGTERM, &action, NULL);
    sigaction(SIGINT, &action, NULL);

    int code = EXIT_USAGE;
    if (strcmp(options.role, "pub") == 0) code = publish(deadline);
    else if (strcmp(options.role, "sub") == 0) code = subscribe(deadline, false);
    else if (strcmp(options.role, "echo") == 0) code = subscribe(deadline, true);
    else if (strcmp(options.role, "ping") == 0) code = ping(deadline);
    else fprintf(stderr, "usage: load pub|sub|echo|ping [options]\n");

    check(rcl_node_fini(&node), "node");
    check(rcl_shutdown(&context), "shutdown");
    fflush(stdout);
    return code;
}
