// A ROS 2-shaped client and server on Fast DDS, with the service mapping of rmw_fastrtps.
//
// The client puts the GUID of its reader into the related sample identity of a request, and takes the replies whose related
// identity is that GUID and the request's sequence number. The server returns what the request said. Included by
// peer.cpp, which has the command line, the types' CDR and the signals.
#pragma once

namespace {

using eprosima::fastrtps::rtps::GUID_t;
using eprosima::fastrtps::rtps::SampleIdentity;
using eprosima::fastrtps::rtps::WriteParams;

// example_interfaces/srv/AddTwoInts.
struct Add {
    struct Request : peer::Keyless {
        static constexpr const char* TYPE = "example_interfaces::srv::dds_::AddTwoInts_Request_";
        int64_t a = 0, b = 0;
        size_t cdr_size_max() const { return 32; }
        void write(eprosima::fastcdr::Cdr& cdr) const { cdr << a << b; }
        void read_from(eprosima::fastcdr::Cdr& cdr) { cdr >> a >> b; }
    };
    struct Response : peer::Keyless {
        static constexpr const char* TYPE = "example_interfaces::srv::dds_::AddTwoInts_Response_";
        int64_t sum = 0;
        size_t cdr_size_max() const { return 16; }
        void write(eprosima::fastcdr::Cdr& cdr) const { cdr << sum; }
        void read_from(eprosima::fastcdr::Cdr& cdr) { cdr >> sum; }
        bool operator==(const Response& other) const { return sum == other.sum; }
    };
    static Request ask(uint64_t seq, size_t) {
        Request made;
        made.a = static_cast<int64_t>(seq);
        made.b = 1000 - 3 * static_cast<int64_t>(seq);
        return made;
    }
    static Response answer(const Request& request) {
        Response made;
        made.sum = request.a + request.b;
        return made;
    }
};

// A service that exists nowhere else, with messages as long as wanted: `size` bytes of noise, there and back.
struct Blob {
    struct Message : peer::Keyless {
        uint64_t seq = 0;
        std::vector<uint8_t> data;
        size_t cdr_size_max() const { return 32 + data.size(); }
        void write(eprosima::fastcdr::Cdr& cdr) const { cdr << seq << data; }
        void read_from(eprosima::fastcdr::Cdr& cdr) { cdr >> seq >> data; }
        bool operator==(const Message& other) const { return seq == other.seq && data == other.data; }
    };
    struct Request : Message {
        static constexpr const char* TYPE = "sgc_test_msgs::srv::dds_::Blob_Request_";
    };
    struct Response : Message {
        static constexpr const char* TYPE = "sgc_test_msgs::srv::dds_::Blob_Response_";
    };
    static Request ask(uint64_t seq, size_t size) {
        Request made;
        made.seq = seq;
        made.data = peer::Noise(seq).take(size);
        return made;
    }
    static Response answer(const Request& request) {
        Response made;
        made.seq = ~request.seq;
        made.data.assign(request.data.rbegin(), request.data.rend());
        return made;
    }
};

// Counts counterparts that are matched with both the reader and the writer of this end.
struct ServiceMatching : DataWriterListener, DataReaderListener {
    explicit ServiceMatching(Stop& stop) : stop(stop) {}
    void on_publication_matched(DataWriter*, const PublicationMatchedStatus& status) override {
        GUID_t reader;
        eprosima::fastrtps::rtps::iHandle2GUID(reader, status.last_subscription_handle);
        update(readers, status.current_count, status.current_count_change, &reader);
    }
    void on_subscription_matched(DataReader*, const SubscriptionMatchedStatus& status) override {
        update(writers, status.current_count, 0, nullptr);
    }
    // Waits as rmw_fastrtps does before it replies: the client's reader may be matched a little later than its writer.
    bool wait_for(const GUID_t& reader) {
        std::unique_lock<std::mutex> lock(mutex);
        return changed.wait_for(lock, std::chrono::milliseconds(100), [&] {
            return std::find(there.begin(), there.end(), reader) != there.end();
        });
    }

    Stop& stop;
    std::mutex mutex;
    std::condition_variable changed;
    std::vector<GUID_t> there;
    int readers = 0, writers = 0;

private:
    void update(int& count, int now, int change, const GUID_t* reader) {
        int before, both;
        {
            std::lock_guard<std::mutex> lock(mutex);
            before = std::min(readers, writers);
            count = now;
            if (reader && change > 0) there.push_back(*reader);
            if (reader && change < 0) there.erase(std::remove(there.begin(), there.end(), *reader), there.end());
            both = std::min(readers, writers);
            changed.notify_all();
        }
        if (both != before) stop.set_matched(both);
    }
};

// The four entities of one end of a service.
template <typename In, typename Out>
struct ServiceEnd {
    ServiceEnd(const Options& options, DomainParticipant* participant, const std::string& in, const std::string& out,
               Stop& stop)
        : participant(participant), matching(stop) {
        TypeSupport in_type(new RosType<In>()), out_type(new RosType<Out>());
        in_type.register_type(participant);
        out_type.register_type(participant);
        in_topic = participant->create_topic(in, In::TYPE, TOPIC_QOS_DEFAULT);
        out_topic = participant->create_topic(out, Out::TYPE, TOPIC_QOS_DEFAULT);
        if (!in_topic || !out_topic) throw std::runtime_error("the topics could not be made");
        publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
        subscriber = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
        DataWriterQos writer_qos = DATAWRITER_QOS_DEFAULT;
        DataReaderQos reader_qos = DATAREADER_QOS_DEFAULT;
        apply(options, writer_qos);
        apply(options, reader_qos);
        writer_qos.publish_mode().kind = ASYNCHRONOUS_PUBLISH_MODE;
        reader = subscriber->create_datareader(in_topic, reader_qos, &matching, StatusMask::subscription_matched());
        writer = publisher->create_datawriter(out_topic, writer_qos, &matching, StatusMask::publication_matched());
        if (!reader || !writer) throw std::runtime_error("the endpoints could not be made");
        reader->get_statuscondition().set_enabled_statuses(StatusMask::data_available());
        waiting.attach_condition(reader->get_statuscondition());
        waiting.attach_condition(stop.guard);
    }

    ~ServiceEnd() {
        waiting.detach_condition(reader->get_statuscondition());
        waiting.detach_condition(matching.stop.guard);
        subscriber->delete_datareader(reader);
        publisher->delete_datawriter(writer);
        participant->delete_subscriber(subscriber);
        participant->delete_publisher(publisher);
        participant->delete_topic(in_topic);
        participant->delete_topic(out_topic);
    }

    DomainParticipant* participant;
    ServiceMatching matching;
    Topic *in_topic = nullptr, *out_topic = nullptr;
    Publisher* publisher = nullptr;
    Subscriber* subscriber = nullptr;
    DataReader* reader = nullptr;
    DataWriter* writer = nullptr;
    WaitSet waiting;
};

template <typename S>
int call(const Options& options, DomainParticipant* participant, Stop& stop, Clock::time_point deadline) {
    ServiceEnd<typename S::Response, typename S::Request> end(options, participant, "rr" + options.topic + "Reply",
                                                              "rq" + options.topic + "Request", stop);
    emit("ready");
    bool matched = stop.wait_matched(options.wait_matched, deadline);
    if (matched && options.wait_go) matched = stop.wait_go(deadline);
    // A server of another vendor may match us later than we match it, and does not get earlier requests.
    if (matched) stop.wait_until(Clock::now() + in_seconds(1));
    uint64_t sent = 0, answered = 0, wrong = 0, foreign = 0;
    std::vector<int64_t> latency_us;
    while (matched && !stop.is_set() && sent < options.count && Clock::now() < deadline) {
        typename S::Request request = S::ask(options.start + sent, options.size);
        WriteParams params;
        params.related_sample_identity().writer_guid() = end.reader->guid();
        const Clock::time_point asked = Clock::now();
        if (!end.writer->write(&request, params)) break;
        ++sent;
        const auto number = params.sample_identity().sequence_number();
        bool done = false;
        while (!done && !stop.is_set() && Clock::now() < deadline) {
            ConditionSeq active;
            if (end.waiting.wait(active, dds_duration(deadline - Clock::now())) != ReturnCode_t::RETCODE_OK) break;
            typename S::Response response;
            SampleInfo info;
            while (end.reader->take_next_sample(&response, &info) == ReturnCode_t::RETCODE_OK) {
                if (!info.valid_data) continue;
                const SampleIdentity& related = info.related_sample_identity;
                const bool ours = related.writer_guid() == end.reader->guid() || related.writer_guid() == end.writer->guid();
                if (!ours || related.sequence_number() != number) {
                    ++foreign;
                    continue;
                }
                done = true;
                ++answered;
                const bool right = response == S::answer(request);
                if (!right) ++wrong;
                if (options.verbose || !right) emit("reply", join({field("seq", options.start + sent - 1), field("ok", right)}));
            }
        }
        if (!done) break;
        latency_us.push_back(std::chrono::duration_cast<std::chrono::microseconds>(Clock::now() - asked).count());
        if (options.rate > 0 && sent < options.count && stop.wait_until(asked + in_seconds(1 / options.rate))) break;
    }
    std::sort(latency_us.begin(), latency_us.end());
    emit("summary", join({"\"role\": \"client\"", field("sent", sent), field("answered", answered), field("wrong", wrong),
                          field("foreign", foreign),
                          field("p50_us", latency_us.empty() ? 0 : latency_us[latency_us.size() / 2])}));
    if (wrong) return EXIT_WRONG;
    return answered >= options.count ? EXIT_FINE : EXIT_INCOMPLETE;
}

template <typename S>
int serve(const Options& options, DomainParticipant* participant, Stop& stop, Clock::time_point deadline) {
    ServiceEnd<typename S::Request, typename S::Response> end(options, participant, "rq" + options.topic + "Request",
                                                              "rr" + options.topic + "Reply", stop);
    emit("ready");
    uint64_t served = 0, unmatched = 0;
    while (!stop.is_set() && Clock::now() < deadline && (options.count == 0 || served < options.count)) {
        ConditionSeq active;
        if (end.waiting.wait(active, dds_duration(deadline - Clock::now())) != ReturnCode_t::RETCODE_OK) break;
        typename S::Request request;
        SampleInfo info;
        while (end.reader->take_next_sample(&request, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data) continue;
            SampleIdentity identity = info.sample_identity;
            const GUID_t& reader = info.related_sample_identity.writer_guid();
            if (reader != GUID_t::unknown()) identity.writer_guid() = reader;
            constexpr uint8_t is_reader = 0x04;
            if ((identity.writer_guid().entityId.value[3] & is_reader) && !end.matching.wait_for(identity.writer_guid()))
                ++unmatched;
            typename S::Response response = S::answer(request);
            WriteParams params;
            params.related_sample_identity() = identity;
            if (!end.writer->write(&response, params)) continue;
            ++served;
            if (options.verbose) emit("served", field("count", served));
        }
    }
    if (served) end.writer->wait_for_acknowledgments(Duration_t(5, 0));
    emit("summary", join({"\"role\": \"server\"", field("served", served), field("unmatched", unmatched)}));
    return served >= options.count ? EXIT_FINE : EXIT_INCOMPLETE;
}

template <typename S>
int run_service(const Options& options, Stop& stop) {
    const Clock::time_point deadline = Clock::now() + in_seconds(options.timeout);
    DomainParticipantFactory* factory = DomainParticipantFactory::get_instance();
    DomainParticipant* participant = factory->create_participant(options.domain, participant_qos(options));
    if (!participant) throw std::runtime_error("the participant could not be made");
    int code = options.role == "client" ? call<S>(options, participant, stop, deadline)
                                        : serve<S>(options, participant, stop, deadline);
    factory->delete_participant(participant);
    return code;
}

}  // namespace
