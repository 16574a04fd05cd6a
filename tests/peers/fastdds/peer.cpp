// A ROS 2-shaped talker and listener on Fast DDS that does not know SGC.
//
// It has the settings of rmw_fastrtps (names, QoS, memory policy, asynchronous publishing) and reports in JSON lines.
// ../README.md specifies the command line and the lines, which the Cyclone DDS peer shares. Nothing polls: discovery arrives
// by listener, data by wait set, signals by sigwait.
#include "messages.hpp"

#include <fastdds/dds/core/condition/GuardCondition.hpp>
#include <fastdds/dds/core/condition/WaitSet.hpp>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/DataWriterListener.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/Topic.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

#include <getopt.h>
#include <signal.h>
#include <time.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <functional>
#include <iostream>
#include <memory>
#include <mutex>
#include <sstream>
#include <thread>
#include <unordered_set>

namespace {

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::Duration_t;
using eprosima::fastrtps::types::ReturnCode_t;
using Clock = std::chrono::steady_clock;

constexpr int EXIT_FINE = 0, EXIT_WRONG = 1, EXIT_USAGE = 2, EXIT_INCOMPLETE = 3;

struct Options {
    std::string role, topic = "/chatter", type = "string", enclave;
    uint32_t domain = 0;
    uint64_t count = 0, start = 0;
    double timeout = 60, rate = 10, hold = 0, linger = 0;
    size_t size = 0;
    int depth = 10, wait_matched = 1;
    bool reliable = true, transient_local = false, localhost = false, udp_only = false, verbose = false;
    bool wait_go = false;
};

void emit(const std::string& event, const std::string& fields = "") {
    static std::mutex printing;
    std::lock_guard<std::mutex> lock(printing);
    std::cout << "{\"event\": \"" << event << "\"" << (fields.empty() ? "" : ", ") << fields << "}" << std::endl;
}

template <typename T>
std::string field(const char* name, const T& value) {
    std::ostringstream out;
    out << std::boolalpha << '"' << name << "\": " << value;
    return out.str();
}

std::string join(std::initializer_list<std::string> fields) {
    std::string all;
    for (const std::string& one : fields) all += (all.empty() ? "" : ", ") + one;
    return all;
}

uint64_t wall_clock_ns() {
    timespec now{};
    clock_gettime(CLOCK_REALTIME, &now);
    return static_cast<uint64_t>(now.tv_sec) * 1000000000ull + static_cast<uint64_t>(now.tv_nsec);
}

Clock::duration in_seconds(double seconds) {
    return std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(seconds));
}

Duration_t dds_duration(Clock::duration left) {
    long double seconds = std::chrono::duration<long double>(left).count();
    return Duration_t(std::max(seconds, 0.0L));
}

// Set once, by a signal or at the end of the work; wakes all waiting threads.
class Stop {
public:
    // Call before any other thread starts: they all inherit the blocked signals.
    Stop() {
        sigset_t signals;
        sigemptyset(&signals);
        sigaddset(&signals, SIGTERM);
        sigaddset(&signals, SIGINT);
        pthread_sigmask(SIG_BLOCK, &signals, nullptr);
        std::thread([this, signals] {
            int number = 0;
            sigwait(&signals, &number);
            std::lock_guard<std::mutex> lock(mutex);
            stopped = true;
            changed.notify_all();
            guard.set_trigger_value(true);
        }).detach();
    }

    std::mutex mutex;
    std::condition_variable changed;
    GuardCondition guard;
    int matched = 0;
    int go = 0;
    bool stopped = false;

    void set_matched(int count) {
        {
            std::lock_guard<std::mutex> lock(mutex);
            matched = count;
            changed.notify_all();
        }
        emit("matched", field("count", count));
    }

    bool is_set() {
        std::lock_guard<std::mutex> lock(mutex);
        return stopped;
    }

    // Returns true when stopped before `until`.
    bool wait_until(Clock::time_point until) {
        std::unique_lock<std::mutex> lock(mutex);
        return changed.wait_until(lock, until, [this] { return stopped; });
    }

    // Returns whether a line came on standard input before `until`, a signal or the end of the input. Called once.
    bool wait_go(Clock::time_point until) {
        std::thread([this] {
            std::string line;
            int answer = std::getline(std::cin, line) ? 1 : -1;
            std::lock_guard<std::mutex> lock(mutex);
            go = answer;
            changed.notify_all();
        }).detach();
        std::unique_lock<std::mutex> lock(mutex);
        changed.wait_until(lock, until, [this] { return stopped || go != 0; });
        return go == 1 && !stopped;
    }

    bool wait_matched(int wanted, Clock::time_point until) {
        std::unique_lock<std::mutex> lock(mutex);
        changed.wait_until(lock, until, [&] { return stopped || matched >= wanted; });
        return matched >= wanted;
    }
};

// Type support like that of ROS 2: a keyless type with a ROS name, in plain CDR.
template <typename M>
class RosType : public TopicDataType {
public:
    RosType() {
        setName(M::TYPE);
        m_typeSize = 1024;  // a first guess: the memory policy grows it
        m_isGetKeyDefined = M::KEYED;
        auto_fill_type_object(false);
        auto_fill_type_information(false);
    }

    bool serialize(void* data, eprosima::fastrtps::rtps::SerializedPayload_t* payload) override {
        eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->max_size);
        eprosima::fastcdr::Cdr cdr(buffer, eprosima::fastcdr::Cdr::DEFAULT_ENDIAN, eprosima::fastcdr::Cdr::DDS_CDR);
        payload->encapsulation = cdr.endianness() == eprosima::fastcdr::Cdr::BIG_ENDIANNESS ? CDR_BE : CDR_LE;
        try {
            cdr.serialize_encapsulation();
            static_cast<const M*>(data)->write(cdr);
        } catch (const std::exception&) {
            return false;
        }
        payload->length = static_cast<uint32_t>(cdr.getSerializedDataLength());
        return true;
    }

    bool deserialize(eprosima::fastrtps::rtps::SerializedPayload_t* payload, void* data) override {
        eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->length);
        eprosima::fastcdr::Cdr cdr(buffer, eprosima::fastcdr::Cdr::DEFAULT_ENDIAN, eprosima::fastcdr::Cdr::DDS_CDR);
        try {
            cdr.read_encapsulation();
            static_cast<M*>(data)->read_from(cdr);
        } catch (const std::exception& error) {
            emit("unreadable", "\"error\": \"" + std::string(error.what()) + "\"");
            *static_cast<M*>(data) = M();  // kept, so that it is counted as altered rather than dropped here
        }
        return true;
    }

    std::function<uint32_t()> getSerializedSizeProvider(void* data) override {
        return [data] { return static_cast<uint32_t>(static_cast<const M*>(data)->cdr_size_max()); };
    }

    void* createData() override { return new M(); }
    void deleteData(void* data) override { delete static_cast<M*>(data); }
    // The key in CDR of big-endian byte order, which fits into the hash (RTPS 2.5, 9.6.4.8).
    bool getKey(void* data, eprosima::fastrtps::rtps::InstanceHandle_t* handle, bool) override {
        if (!M::KEYED) return false;
        uint32_t key = static_cast<const M*>(data)->key();
        for (int i = 0; i < 16; ++i) handle->value[i] = i < 4 ? static_cast<uint8_t>(key >> (24 - 8 * i)) : 0;
        return true;
    }
};

template <typename Qos>
void apply(const Options& options, Qos& qos) {
    qos.reliability().kind = options.reliable ? RELIABLE_RELIABILITY_QOS : BEST_EFFORT_RELIABILITY_QOS;
    qos.reliability().max_blocking_time = Duration_t(10, 0);
    qos.durability().kind = options.transient_local ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
    qos.history().kind = options.depth ? KEEP_LAST_HISTORY_QOS : KEEP_ALL_HISTORY_QOS;
    if (options.depth) {
        qos.history().depth = options.depth;
        qos.resource_limits().max_samples_per_instance =
            std::max(qos.resource_limits().max_samples_per_instance, options.depth);
        qos.resource_limits().max_samples = std::max(qos.resource_limits().max_samples, options.depth);
    }
    qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
}

// Secures a participant with the files of an enclave, and names the enclave, as rmw_fastrtps does.
void secure(const std::string& enclave, DomainParticipantQos& qos) {
    const std::string user_data = "enclave=" + enclave.substr(enclave.rfind('/')) + ";";
    qos.user_data().setValue(std::vector<unsigned char>(user_data.begin(), user_data.end()));
    const std::string identity = "dds.sec.auth.builtin.PKI-DH.", access = "dds.sec.access.builtin.Access-Permissions.";
    const std::pair<std::string, std::string> files[] = {
        {identity + "identity_ca", "identity_ca.cert.pem"},      {identity + "identity_certificate", "cert.pem"},
        {identity + "private_key", "key.pem"},                   {access + "permissions_ca", "permissions_ca.cert.pem"},
        {access + "governance", "governance.p7s"},               {access + "permissions", "permissions.p7s"},
    };
    auto& properties = qos.properties().properties();
    properties.emplace_back("dds.sec.auth.plugin", "builtin.PKI-DH");
    properties.emplace_back("dds.sec.access.plugin", "builtin.Access-Permissions");
    properties.emplace_back("dds.sec.crypto.plugin", "builtin.AES-GCM-GMAC");
    for (const auto& [property, file] : files) properties.emplace_back(property, "file://" + enclave + "/" + file);
}

DomainParticipantQos participant_qos(const Options& options) {
    DomainParticipantQos qos = PARTICIPANT_QOS_DEFAULT;
    qos.name("/sgc_test_peer");
    if (!options.enclave.empty()) secure(options.enclave, qos);
    if (!options.localhost && !options.udp_only) return qos;
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    qos.transport().use_builtin_transports = false;
    if (options.localhost) {
        udp->interfaceWhiteList.push_back("127.0.0.1");
        // Announce both ways: by multicast on `lo`, and to the first participant ports for those who do not listen to it.
        udp->maxInitialPeersRange = 16;
        eprosima::fastrtps::rtps::Locator_t unicast, multicast;
        eprosima::fastrtps::rtps::IPLocator::setIPv4(unicast, "127.0.0.1");
        eprosima::fastrtps::rtps::IPLocator::setIPv4(multicast, "239.255.0.1");
        qos.wire_protocol().builtin.initialPeersList.push_back(unicast);
        qos.wire_protocol().builtin.initialPeersList.push_back(multicast);
    }
    qos.transport().user_transports.push_back(udp);
    return qos;
}

struct Matching : DataWriterListener, DataReaderListener {
    explicit Matching(Stop& stop) : stop(stop) {}
    void on_publication_matched(DataWriter*, const PublicationMatchedStatus& status) override {
        stop.set_matched(status.current_count);
    }
    void on_subscription_matched(DataReader*, const SubscriptionMatchedStatus& status) override {
        stop.set_matched(status.current_count);
    }
    Stop& stop;
};

// The record of received messages.
class Tally {
public:
    void add(const peer::Reading& reading) {
        latency_us_.push_back((static_cast<int64_t>(wall_clock_ns()) - static_cast<int64_t>(reading.stamp_ns)) / 1000);
        if (!reading.intact) {
            ++altered;
        } else if (!seen_.insert(reading.seq).second) {
            ++duplicated;
        } else {
            if (seen_.size() == 1) first_ = last_ = reading.seq;
            if (reading.seq < last_) ++reordered_;
            first_ = std::min(first_, reading.seq);
            last_ = std::max(last_, reading.seq);
        }
    }

    uint64_t received() const { return seen_.size(); }

    std::string summary() {
        std::sort(latency_us_.begin(), latency_us_.end());
        auto pick = [this](double part) -> std::string {
            if (latency_us_.empty()) return "null";
            size_t at = static_cast<size_t>(static_cast<double>(latency_us_.size()) * part);
            return std::to_string(latency_us_[std::min(at, latency_us_.size() - 1)]);
        };
        bool any = !seen_.empty();
        return join({field("received", received()), field("first", any ? std::to_string(first_) : "null"),
                     field("last", any ? std::to_string(last_) : "null"),
                     field("lost", any ? last_ - first_ + 1 - received() : 0), field("duplicated", duplicated),
                     field("altered", altered), field("reordered", reordered_),
                     "\"latency_us\": {" + join({field("p50", pick(0.5)), field("p99", pick(0.99)), field("max", pick(1))}) +
                         "}"});
    }

    uint64_t altered = 0, duplicated = 0;

private:
    std::unordered_set<uint64_t> seen_;
    std::vector<int64_t> latency_us_;
    uint64_t first_ = 0, last_ = 0, reordered_ = 0;
};

// Reads the number and time inside a message. A message that cannot be read is not intact. A default value set before the call
// does not cover an exception: GCC 12 (-fipa-modref) drops it, and stack content would count as the message.
template <typename M>
peer::Reading read(const M& message) {
    try {
        return message.read();
    } catch (const std::exception& error) {
        emit("unreadable", "\"error\": \"" + std::string(error.what()) + "\"");
        return {0, wall_clock_ns(), false};
    }
}

template <typename M>
int publish(const Options& options, DomainParticipant* participant, Topic* topic, Stop& stop, Clock::time_point deadline) {
    Publisher* publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
    DataWriterQos qos = DATAWRITER_QOS_DEFAULT;
    apply(options, qos);
    qos.publish_mode().kind = ASYNCHRONOUS_PUBLISH_MODE;
    Matching listener(stop);
    DataWriter* writer = publisher->create_datawriter(topic, qos, &listener, StatusMask::publication_matched());
    if (!writer) throw std::runtime_error("the writer could not be made");
    emit("ready");
    bool matched = stop.wait_matched(options.wait_matched, deadline);
    if (matched && options.wait_go) matched = stop.wait_go(deadline);
    uint64_t sent = 0, seq = options.start;
    const Clock::time_point first_at = Clock::now();
    while (matched && !stop.is_set() && (options.count == 0 || sent < options.count)) {
        Clock::time_point due =
            options.rate > 0 ? first_at + in_seconds(static_cast<double>(sent) / options.rate) : first_at;
        if (due > deadline || Clock::now() > deadline || (due > Clock::now() && stop.wait_until(due))) break;
        M message = M::make(seq, wall_clock_ns(), options.size);
        if (!writer->write(&message)) {
            emit("refused", field("seq", seq));
            break;
        }
        if (options.verbose) emit("sent", field("seq", seq));
        ++sent;
        ++seq;
    }
    double seconds = std::chrono::duration<double>(Clock::now() - first_at).count();
    std::string acknowledged = "null";
    if (options.reliable && sent && !stop.is_set()) {
        bool all = writer->wait_for_acknowledgments(dds_duration(deadline - Clock::now())) == ReturnCode_t::RETCODE_OK;
        acknowledged = all ? "true" : "false";
    }
    emit("all_sent", join({field("sent", sent), field("acknowledged", acknowledged)}));
    if (options.hold > 0) stop.wait_until(Clock::now() + in_seconds(options.hold));
    emit("summary", join({"\"role\": \"pub\"", field("sent", sent),
                          field("first", sent ? std::to_string(options.start) : "null"),
                          field("last", sent ? std::to_string(seq - 1) : "null"), field("seconds", seconds),
                          field("acknowledged", acknowledged), field("matched", stop.matched)}));
    publisher->delete_datawriter(writer);
    participant->delete_publisher(publisher);
    if (stop.is_set()) return EXIT_FINE;
    return matched && sent >= options.count && acknowledged != "false" ? EXIT_FINE : EXIT_INCOMPLETE;
}

template <typename M>
int subscribe(const Options& options, DomainParticipant* participant, Topic* topic, Stop& stop, Clock::time_point deadline) {
    Subscriber* subscriber = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
    DataReaderQos qos = DATAREADER_QOS_DEFAULT;
    apply(options, qos);
    Matching listener(stop);
    DataReader* reader = subscriber->create_datareader(topic, qos, &listener, StatusMask::subscription_matched());
    if (!reader) throw std::runtime_error("the reader could not be made");
    reader->get_statuscondition().set_enabled_statuses(StatusMask::data_available());
    WaitSet waiting;
    waiting.attach_condition(reader->get_statuscondition());
    waiting.attach_condition(stop.guard);
    emit("ready");
    Tally tally;
    bool complete = false;
    M message;
    SampleInfo info;
    while (!stop.is_set()) {
        if (!complete && options.count && tally.received() >= options.count) {
            complete = true;
            deadline = std::min(deadline, Clock::now() + in_seconds(options.linger));
        }
        ConditionSeq active;
        if (Clock::now() >= deadline || waiting.wait(active, dds_duration(deadline - Clock::now())) != ReturnCode_t::RETCODE_OK)
            break;
        while (reader->take_next_sample(&message, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data) continue;
            const peer::Reading reading = read(message);
            tally.add(reading);
            if (options.verbose || !reading.intact)
                emit("received", join({field("seq", reading.seq), field("ok", reading.intact)}));
        }
    }
    emit("summary", join({"\"role\": \"sub\"", field("matched", stop.matched), tally.summary()}));
    waiting.detach_condition(reader->get_statuscondition());
    waiting.detach_condition(stop.guard);
    subscriber->delete_datareader(reader);
    participant->delete_subscriber(subscriber);
    if (tally.altered || tally.duplicated) return EXIT_WRONG;
    return stop.is_set() || tally.received() >= options.count ? EXIT_FINE : EXIT_INCOMPLETE;
}

template <typename M>
int run(const Options& options, Stop& stop) {
    const Clock::time_point deadline = Clock::now() + in_seconds(options.timeout);
    DomainParticipantFactory* factory = DomainParticipantFactory::get_instance();
    DomainParticipant* participant = factory->create_participant(options.domain, participant_qos(options));
    if (!participant) throw std::runtime_error("the participant could not be made");
    TypeSupport type(new RosType<M>());
    type.register_type(participant);
    Topic* topic = participant->create_topic("rt" + options.topic, M::TYPE, TOPIC_QOS_DEFAULT);
    if (!topic) throw std::runtime_error("the topic could not be made");
    int code = options.role == "pub" ? publish<M>(options, participant, topic, stop, deadline)
                                     : subscribe<M>(options, participant, topic, stop, deadline);
    participant->delete_topic(topic);
    factory->delete_participant(participant);
    return code;
}

}  // namespace

#include "service.hpp"

namespace {

[[noreturn]] void usage(const std::string& problem) {
    std::cerr << "peer: " << problem << "; usage: peer pub|sub|client|server [options], see tests/peers/README.md\n";
    std::exit(EXIT_USAGE);
}

Options parse(int argc, char** argv) {
    Options options;
    if (argc < 2) usage("no role");
    options.role = argv[1];
    const bool is_service = options.role == "client" || options.role == "server";
    if (is_service) options.type = "add";
    if (options.role != "pub" && options.role != "sub" && !is_service) usage("no such role: " + options.role);
    static const option known[] = {{"domain", 1, nullptr, 'd'},       {"topic", 1, nullptr, 't'},
                                   {"type", 1, nullptr, 'y'},         {"count", 1, nullptr, 'c'},
                                   {"timeout", 1, nullptr, 'o'},      {"rate", 1, nullptr, 'r'},
                                   {"size", 1, nullptr, 's'},         {"start", 1, nullptr, 'f'},
                                   {"wait-matched", 1, nullptr, 'w'}, {"hold", 1, nullptr, 'h'},
                                   {"linger", 1, nullptr, 'l'},       {"depth", 1, nullptr, 'k'},
                                   {"enclave", 1, nullptr, 'e'},      {"wait-go", 0, nullptr, 'g'},
                                   {"large", 0, nullptr, 'G'},
                                   {"reliable", 0, nullptr, 'R'},     {"best-effort", 0, nullptr, 'B'},
                                   {"transient-local", 0, nullptr, 'T'}, {"localhost", 0, nullptr, 'L'},
                                   {"udp-only", 0, nullptr, 'U'},     {"verbose", 0, nullptr, 'v'},
                                   {nullptr, 0, nullptr, 0}};
    optind = 2;
    try {
        for (int found; (found = getopt_long(argc, argv, "", known, nullptr)) != -1;) {
            switch (found) {
                case 'd': options.domain = static_cast<uint32_t>(std::stoul(optarg)); break;
                case 't': options.topic = optarg; break;
                case 'y': options.type = optarg; break;
                case 'c': options.count = std::stoull(optarg); break;
                case 'o': options.timeout = std::stod(optarg); break;
                case 'r': options.rate = std::stod(optarg); break;
                case 's': options.size = std::stoull(optarg); break;
                case 'f': options.start = std::stoull(optarg); break;
                case 'w': options.wait_matched = std::stoi(optarg); break;
                case 'h': options.hold = std::stod(optarg); break;
                case 'l': options.linger = std::stod(optarg); break;
                case 'e': options.enclave = optarg; break;
                case 'g': options.wait_go = true; break;
                case 'k': options.depth = std::stoi(optarg); break;
                case 'R': options.reliable = true; break;
                case 'B': options.reliable = false; break;
                case 'T': options.transient_local = true; break;
                case 'L': options.localhost = true; break;
                case 'U': options.udp_only = true; break;
                case 'G': break;  // Fast DDS needs no settings for large messages
                case 'v': options.verbose = true; break;
                default: usage("an option that is not known");
            }
        }
    } catch (const std::exception&) {
        usage("a value that is no number");
    }
    if (optind < argc) usage(std::string("left over: ") + argv[optind]);
    return options;
}

}  // namespace

int main(int argc, char** argv) {
    const Options options = parse(argc, argv);
    static Stop stop;
    try {
        if (options.role == "client" || options.role == "server") {
            if (options.type == "add") return run_service<Add>(options, stop);
            if (options.type == "blob") return run_service<Blob>(options, stop);
            usage("no such type of service: " + options.type);
        }
        if (options.type == "string") return run<peer::String>(options, stop);
        if (options.type == "image") return run<peer::Image>(options, stop);
        if (options.type == "custom") return run<peer::Odd>(options, stop);
        if (options.type == "wstring") return run<peer::WString>(options, stop);
        if (options.type == "pointcloud") return run<peer::PointCloud2>(options, stop);
        if (options.type == "keyed") return run<peer::Keyed>(options, stop);
        usage("no such type: " + options.type);
    } catch (const std::exception& error) {
        std::cerr << "peer: " << error.what() << "\n";
        return EXIT_USAGE;
    }
}
