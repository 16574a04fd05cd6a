// The message types of the peers and the content of each message; the C++ counterpart of ../py/messages.py.
// ../README.md specifies both. libfastcdr writes and reads CDR, as in a ROS 2 type support.
#pragma once

#include <fastcdr/Cdr.h>
#include <fastcdr/FastBuffer.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <stdexcept>
#include <string>
#include <vector>

namespace peer {

using eprosima::fastcdr::Cdr;

// splitmix64: the same bytes on both sides from one seed.
class Noise {
public:
    explicit Noise(uint64_t seed) : state_(seed) {}

    uint64_t next() {
        state_ += 0x9E3779B97F4A7C15ull;
        uint64_t z = state_;
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull;
        z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
        return z ^ (z >> 31);
    }

    std::vector<uint8_t> take(size_t count) {
        std::vector<uint8_t> bytes;
        bytes.reserve(count + 8);
        while (bytes.size() < count) {
            uint64_t word = next();
            for (int i = 0; i < 8; ++i) bytes.push_back(static_cast<uint8_t>(word >> (8 * i)));
        }
        bytes.resize(count);
        return bytes;
    }

private:
    uint64_t state_;
};

// CRC-32 (IEEE 802.3), eight bytes at a time: an image of 13 MB should not take longer to check than to send.
class Crc32 {
public:
    Crc32& add(const void* data, size_t length) {
        static const Tables tables = make_tables();
        const uint8_t* at = static_cast<const uint8_t*>(data);
        uint32_t crc = ~value_;
        for (; length >= 8; length -= 8, at += 8) {
            uint32_t low, high;
            std::memcpy(&low, at, 4);
            std::memcpy(&high, at + 4, 4);
            low ^= crc;
            crc = tables[7][low & 0xff] ^ tables[6][(low >> 8) & 0xff] ^ tables[5][(low >> 16) & 0xff] ^
                  tables[4][low >> 24] ^ tables[3][high & 0xff] ^ tables[2][(high >> 8) & 0xff] ^
                  tables[1][(high >> 16) & 0xff] ^ tables[0][high >> 24];
        }
        for (; length > 0; --length, ++at) crc = (crc >> 8) ^ tables[0][(crc ^ *at) & 0xff];
        value_ = ~crc;
        return *this;
    }

    uint32_t value() const { return value_; }

private:
    using Tables = std::array<std::array<uint32_t, 256>, 8>;

    static Tables make_tables() {
        Tables tables{};
        for (uint32_t i = 0; i < 256; ++i) {
            uint32_t crc = i;
            for (int bit = 0; bit < 8; ++bit) crc = (crc & 1) ? (crc >> 1) ^ 0xEDB88320u : crc >> 1;
            tables[0][i] = crc;
        }
        for (size_t table = 1; table < 8; ++table)
            for (size_t i = 0; i < 256; ++i)
                tables[table][i] = (tables[table - 1][i] >> 8) ^ tables[0][tables[table - 1][i] & 0xff];
        return tables;
    }

    uint32_t value_ = 0;
};

// The number and time inside a received message, and whether its content is intact.
struct Reading {
    uint64_t seq;
    uint64_t stamp_ns;
    bool intact;
};

// A type without a key.
struct Keyless {
    static constexpr bool KEYED = false;
    uint32_t key() const { return 0; }
};

struct String : Keyless {
    static constexpr const char* TYPE = "std_msgs::msg::dds_::String_";
    std::string data;

    static String make(uint64_t seq, uint64_t stamp_ns, size_t size) {
        static const char digits[] = "0123456789abcdef";
        size_t filler_length = size ? size : seq % 23;
        std::string filler;
        for (uint8_t byte : Noise(seq).take(filler_length)) {
            filler += digits[byte >> 4];
            filler += digits[byte & 15];
        }
        filler.resize(filler_length);
        String made;
        made.data = "seq=" + std::to_string(seq) + " t=" + std::to_string(stamp_ns) + " fill=" + filler;
        char crc[16];
        std::snprintf(crc, sizeof crc, " crc=%08x", Crc32().add(made.data.data(), made.data.size()).value());
        made.data += crc;
        return made;
    }

    Reading read() const {
        unsigned long long seq = 0, stamp_ns = 0;
        int fill_at = -1;
        if (std::sscanf(data.c_str(), "seq=%llu t=%llu fill=%n", &seq, &stamp_ns, &fill_at) < 2 || fill_at < 0)
            throw std::runtime_error("no sequence number in the text");
        size_t fill_end = data.find(' ', static_cast<size_t>(fill_at));
        if (fill_end == std::string::npos) throw std::runtime_error("no checksum in the text");
        size_t filler_length = fill_end - static_cast<size_t>(fill_at);
        size_t size = filler_length == seq % 23 ? 0 : filler_length;
        return {seq, stamp_ns, data == make(seq, stamp_ns, size).data};
    }

    size_t cdr_size_max() const { return 16 + data.size(); }
    void write(Cdr& cdr) const { cdr << data; }
    void read_from(Cdr& cdr) { cdr >> data; }
};

// A `wstring` as `ros2-client` writes it: the count of UTF-16 code units, and the units.
struct WString : Keyless {
    static constexpr const char* TYPE = "std_msgs::msg::dds_::WString_";
    std::u16string data;

    static WString make(uint64_t seq, uint64_t stamp_ns, size_t size) {
        // One, two and three bytes of UTF-8 a character, and one that takes two units of UTF-16.
        static const std::u16string wide[] = {u"a", u"\u00e9", u"\u0416", u"\u6f22", u"\u3042", u"\U0001f916", u"\u20ac", u"z"};
        WString made;
        made.data = widen("seq=" + std::to_string(seq) + " t=" + std::to_string(stamp_ns) + " fill=");
        for (uint8_t byte : Noise(seq).take(size ? size : seq % 23)) made.data += wide[byte & 7];
        char crc[16];
        std::snprintf(crc, sizeof crc, " crc=%08x", Crc32().add(made.data.data(), made.data.size() * 2).value());
        made.data += widen(crc);
        return made;
    }

    Reading read() const {
        std::string narrow;
        size_t spaces = 0, filler_length = 0;
        for (char16_t unit : data) {
            narrow += unit < 0x80 ? static_cast<char>(unit) : '?';
            if (unit == u' ') ++spaces;
        }
        unsigned long long seq = 0, stamp_ns = 0;
        int fill_at = -1;
        if (std::sscanf(narrow.c_str(), "seq=%llu t=%llu fill=%n", &seq, &stamp_ns, &fill_at) < 2 || fill_at < 0 || spaces != 3)
            throw std::runtime_error("no sequence number in the text");
        for (size_t at = static_cast<size_t>(fill_at); data[at] != u' '; ++at)
            if ((data[at] & 0xfc00) != 0xdc00) ++filler_length;  // a pair is one character
        size_t size = filler_length == seq % 23 ? 0 : filler_length;
        return {seq, stamp_ns, data == make(seq, stamp_ns, size).data};
    }

    size_t cdr_size_max() const { return 16 + data.size() * 2; }
    void write(Cdr& cdr) const {
        cdr << static_cast<uint32_t>(data.size());
        for (char16_t unit : data) cdr << static_cast<uint16_t>(unit);
    }
    void read_from(Cdr& cdr) {
        uint32_t count = 0;
        cdr >> count;
        if (count > 1 << 20) throw std::runtime_error("a text of more than a million units");
        data.resize(count);
        for (char16_t& unit : data) {
            uint16_t value = 0;
            cdr >> value;
            unit = value;
        }
    }

private:
    static std::u16string widen(const std::string& text) { return std::u16string(text.begin(), text.end()); }
};

// Sequence number, time, checksum, and a cut of the repeated noise block.
struct Bulk {
    static constexpr size_t HEAD_BYTES = 20;

    static std::vector<uint8_t> make(uint64_t seq, uint64_t stamp_ns, size_t size) {
        constexpr size_t block_bytes = 1 << 16;
        static const std::vector<uint8_t> block = Noise(0x5347435F50454552ull).take(block_bytes);
        std::vector<uint8_t> data(size);
        std::memcpy(data.data(), &seq, 8);
        std::memcpy(data.data() + 8, &stamp_ns, 8);
        for (size_t at = HEAD_BYTES, from = (seq * 7919) % block_bytes; at < size; from = 0) {
            size_t run = std::min(block_bytes - from, size - at);
            std::memcpy(data.data() + at, block.data() + from, run);
            at += run;
        }
        uint32_t crc = Crc32().add(data.data(), 16).add(data.data() + HEAD_BYTES, size - HEAD_BYTES).value();
        std::memcpy(data.data() + 16, &crc, 4);
        return data;
    }
};

struct Image : Keyless {
    static constexpr const char* TYPE = "sensor_msgs::msg::dds_::Image_";
    static constexpr size_t HEAD_BYTES = Bulk::HEAD_BYTES;
    int32_t sec = 0;
    uint32_t nanosec = 0;
    std::string frame_id;
    uint32_t height = 0, width = 0;
    std::string encoding;
    uint8_t is_bigendian = 0;
    uint32_t step = 0;
    std::vector<uint8_t> data;

    static Image make(uint64_t seq, uint64_t stamp_ns, size_t size) {
        size = std::max(size, HEAD_BYTES);
        Image made;
        made.sec = static_cast<int32_t>(stamp_ns / 1000000000ull);
        made.nanosec = static_cast<uint32_t>(stamp_ns % 1000000000ull);
        made.frame_id = "sgc/" + std::to_string(seq);
        made.height = 1;
        made.width = made.step = static_cast<uint32_t>(size);
        made.encoding = "mono8";
        made.data = Bulk::make(seq, stamp_ns, size);
        return made;
    }

    Reading read() const {
        if (data.size() < HEAD_BYTES) throw std::runtime_error("image shorter than its head");
        uint64_t seq, stamp_ns;
        std::memcpy(&seq, data.data(), 8);
        std::memcpy(&stamp_ns, data.data() + 8, 8);
        Image good = make(seq, stamp_ns, data.size());
        bool intact = good.data == data && good.sec == sec && good.nanosec == nanosec && good.frame_id == frame_id &&
                      good.height == height && good.width == width && good.encoding == encoding &&
                      good.is_bigendian == is_bigendian && good.step == step;
        return {seq, stamp_ns, intact};
    }

    size_t cdr_size_max() const { return 64 + frame_id.size() + encoding.size() + data.size(); }
    void write(Cdr& cdr) const {
        cdr << sec << nanosec << frame_id << height << width << encoding << is_bigendian << step << data;
    }
    void read_from(Cdr& cdr) {
        cdr >> sec >> nanosec >> frame_id >> height >> width >> encoding >> is_bigendian >> step >> data;
    }
};

struct PointField {
    std::string name;
    uint32_t offset = 0;
    uint8_t datatype = 0;
    uint32_t count = 0;

    bool operator==(const PointField& other) const {
        return name == other.name && offset == other.offset && datatype == other.datatype && count == other.count;
    }
};

struct PointCloud2 : Keyless {
    static constexpr const char* TYPE = "sensor_msgs::msg::dds_::PointCloud2_";
    static constexpr size_t POINT_BYTES = 16, DEFAULT_BYTES = 6000000, FIELDS_MAX = 16;
    static constexpr uint8_t FLOAT32 = 7;
    int32_t sec = 0;
    uint32_t nanosec = 0;
    std::string frame_id;
    uint32_t height = 0, width = 0;
    std::vector<PointField> fields;
    bool is_bigendian = false;
    uint32_t point_step = 0, row_step = 0;
    std::vector<uint8_t> data;
    bool is_dense = false;

    static PointCloud2 make(uint64_t seq, uint64_t stamp_ns, size_t size) {
        size_t points = std::max(((size ? size : DEFAULT_BYTES) + POINT_BYTES - 1) / POINT_BYTES, size_t{2});
        PointCloud2 made;
        made.sec = static_cast<int32_t>(stamp_ns / 1000000000ull);
        made.nanosec = static_cast<uint32_t>(stamp_ns % 1000000000ull);
        made.frame_id = "sgc/" + std::to_string(seq);
        made.height = 1;
        made.width = static_cast<uint32_t>(points);
        uint32_t offset = 0;
        for (const char* name : {"x", "y", "z", "intensity"}) {
            made.fields.push_back({name, offset, FLOAT32, 1});
            offset += 4;
        }
        made.point_step = POINT_BYTES;
        made.row_step = static_cast<uint32_t>(points * POINT_BYTES);
        made.data = Bulk::make(seq, stamp_ns, points * POINT_BYTES);
        made.is_dense = true;
        return made;
    }

    Reading read() const {
        if (data.size() < Bulk::HEAD_BYTES) throw std::runtime_error("cloud shorter than its head");
        uint64_t seq, stamp_ns;
        std::memcpy(&seq, data.data(), 8);
        std::memcpy(&stamp_ns, data.data() + 8, 8);
        PointCloud2 good = make(seq, stamp_ns, data.size());
        bool intact = good.data == data && good.sec == sec && good.nanosec == nanosec && good.frame_id == frame_id &&
                      good.height == height && good.width == width && good.fields == fields &&
                      good.is_bigendian == is_bigendian && good.point_step == point_step && good.row_step == row_step &&
                      good.is_dense == is_dense;
        return {seq, stamp_ns, intact};
    }

    size_t cdr_size_max() const { return 256 + frame_id.size() + fields.size() * 64 + data.size(); }
    void write(Cdr& cdr) const {
        cdr << sec << nanosec << frame_id << height << width << static_cast<uint32_t>(fields.size());
        for (const PointField& field : fields) cdr << field.name << field.offset << field.datatype << field.count;
        cdr << is_bigendian << point_step << row_step << data << is_dense;
    }
    void read_from(Cdr& cdr) {
        uint32_t count = 0;
        cdr >> sec >> nanosec >> frame_id >> height >> width >> count;
        if (count > FIELDS_MAX) throw std::runtime_error("more fields than a cloud has");
        fields.resize(count);
        for (PointField& field : fields) cdr >> field.name >> field.offset >> field.datatype >> field.count;
        cdr >> is_bigendian >> point_step >> row_step >> data >> is_dense;
    }
};

// Five instances, each with a history of its own.
struct Keyed {
    static constexpr const char* TYPE = "sgc_test_msgs::msg::dds_::Keyed_";
    static constexpr bool KEYED = true;
    static constexpr size_t DATA_MAX = 64;
    uint32_t sensor = 0;
    uint64_t seq = 0, stamp_ns = 0;
    uint32_t crc = 0;
    std::vector<uint8_t> data;

    uint32_t key() const { return sensor; }

    static Keyed make(uint64_t seq, uint64_t stamp_ns, size_t) {
        Keyed made;
        made.sensor = static_cast<uint32_t>(seq % 5);
        made.seq = seq;
        made.stamp_ns = stamp_ns;
        made.data = Noise(seq).take(1 + seq % 31);
        made.crc = Crc32().add(&made.seq, 8).add(&made.stamp_ns, 8).add(made.data.data(), made.data.size()).value();
        return made;
    }

    Reading read() const {
        Keyed good = make(seq, stamp_ns, 0);
        return {seq, stamp_ns, good.sensor == sensor && good.crc == crc && good.data == data};
    }

    size_t cdr_size_max() const { return 64 + data.size(); }
    void write(Cdr& cdr) const { cdr << sensor << seq << stamp_ns << crc << data; }
    void read_from(Cdr& cdr) {
        cdr >> sensor >> seq >> stamp_ns >> crc >> data;
        if (data.size() > DATA_MAX) throw std::runtime_error("a sequence beyond its bound");
    }
};

struct Inner {
    int16_t offset = 0;
    double weight = 0;
    std::string label;

    bool operator==(const Inner& other) const {
        return offset == other.offset && weight == other.weight && label == other.label;
    }
    void write(Cdr& cdr) const { cdr << offset << weight << label; }
    void read_from(Cdr& cdr) { cdr >> offset >> weight >> label; }
};

// A type that no ROS distribution has: nested, bounded, mixed alignment, and a tail of odd length.
struct Odd : Keyless {
    static constexpr const char* TYPE = "sgc_test_msgs::msg::dds_::Odd_";
    static constexpr size_t PARTS_MAX = 4, CODES_MAX = 32, TAIL_MAX = 64;
    bool flag = false;
    uint64_t seq = 0, stamp_ns = 0;
    uint32_t crc = 0;
    Inner inner;
    std::vector<Inner> parts;
    std::vector<uint16_t> codes;
    std::array<float, 3> fixed{};
    std::vector<uint8_t> tail;

    static Odd make(uint64_t seq, uint64_t stamp_ns, size_t) {
        Noise noise(seq);
        Odd made;
        made.flag = seq % 2 == 1;
        made.seq = seq;
        made.stamp_ns = stamp_ns;
        for (uint64_t i = 0; i < 1 + seq % 5; ++i) {
            Inner inner;
            inner.offset = static_cast<int16_t>(static_cast<int64_t>(noise.next() % 2000) - 1000);
            inner.weight = static_cast<double>(noise.next() % 100000) / 8.0;
            inner.label = "part-" + std::to_string(i) + "-" + std::to_string(seq % 1000);
            if (i == 0)
                made.inner = inner;
            else
                made.parts.push_back(inner);
        }
        for (uint64_t i = 0; i < seq % 33; ++i) made.codes.push_back(static_cast<uint16_t>(noise.next() % 65536));
        for (float& value : made.fixed) value = static_cast<float>(noise.next() % 4096) / 4.0f;
        made.tail = noise.take(1 + 2 * (seq % 31));
        made.crc = Crc32()
                       .add(&made.seq, 8)
                       .add(&made.stamp_ns, 8)
                       .add(made.codes.data(), made.codes.size() * 2)
                       .add(made.tail.data(), made.tail.size())
                       .value();
        return made;
    }

    Reading read() const {
        Odd good = make(seq, stamp_ns, 0);
        bool intact = good.flag == flag && good.crc == crc && good.inner == inner && good.parts == parts &&
                      good.codes == codes && good.fixed == fixed && good.tail == tail;
        return {seq, stamp_ns, intact};
    }

    size_t cdr_size_max() const {
        size_t labels = inner.label.size();
        for (const Inner& part : parts) labels += part.label.size();
        return 128 + labels + parts.size() * 32 + codes.size() * 2 + tail.size();
    }
    void write(Cdr& cdr) const {
        cdr << flag << seq << stamp_ns << crc;
        inner.write(cdr);
        cdr << static_cast<uint32_t>(parts.size());
        for (const Inner& part : parts) part.write(cdr);
        cdr << codes;
        cdr.serializeArray(fixed.data(), fixed.size());
        cdr << tail;
    }
    void read_from(Cdr& cdr) {
        uint32_t part_count = 0;
        cdr >> flag >> seq >> stamp_ns >> crc;
        inner.read_from(cdr);
        cdr >> part_count;
        if (part_count > PARTS_MAX) throw std::runtime_error("more parts than the bound");
        parts.resize(part_count);
        for (Inner& part : parts) part.read_from(cdr);
        cdr >> codes;
        cdr.deserializeArray(fixed.data(), fixed.size());
        cdr >> tail;
        if (codes.size() > CODES_MAX || tail.size() > TAIL_MAX) throw std::runtime_error("a sequence beyond its bound");
    }
};

}  // namespace peer
