// A consumer in C++17, written from docs/wire.md alone: the drawn image and its metric depth.
//
//     read_depth [ENDPOINT] [FRAMES]      default: tcp://127.0.0.1:5556, until Ctrl-C
//
// Prints one line for every frame, and "stale" once when there is nothing new to show.

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <exception>
#include <iostream>
#include <iterator>
#include <limits>
#include <map>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <msgpack.hpp>
#include <zmq.hpp>
#include <zmq_addon.hpp>

namespace {

const std::string IMAGE = "sags/left/render/image";  // rgba8
const std::string DEPTH = "sags/left/render/depth";  // 32FC1, metres, NaN where the model says nothing

constexpr std::size_t MAX_PARTS = 8;
constexpr std::size_t MAX_META_BYTES = 4096;
constexpr std::int64_t MAX_PART_BYTES = 128 << 20;
constexpr std::int64_t MAX_SIDE = 16384;    // px
constexpr std::size_t KEPT = 4;             // messages of a topic, to join topics by their stamp
constexpr std::size_t WINDOW = 20;          // messages behind the period and the rate
constexpr double STALE_PERIODS = 10;
constexpr double STALE_AFTER = 0.5;         // s, at most
constexpr double MIN_RATE = 0.9;            // of the messages sent
constexpr double UNKNOWN_PERIOD = 0.1;      // s, until two messages have come

std::int64_t now_ns() {
    const auto now = std::chrono::system_clock::now().time_since_epoch();
    return std::chrono::duration_cast<std::chrono::nanoseconds>(now).count();
}

struct Message {
    std::string session;
    std::int64_t epoch = 0, seq = 0, stamp_ns = 0;
    std::int64_t height = 0, width = 0;
    bool metric = true;  // false: nobody has calibrated the eyes, and lengths have no unit
    zmq::message_t data;  // the pixels, as they were received
};

// Little-endian on the wire, whatever this machine is, and at any address.
float float_at(const zmq::message_t& data, std::size_t index) {
    const auto* bytes = data.data<unsigned char>() + 4 * index;
    const std::uint32_t bits = bytes[0] | bytes[1] << 8 | bytes[2] << 16 | std::uint32_t{bytes[3]} << 24;
    float value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

// Throws std::exception for what is no image of the kind that is due on this topic.
Message decode(const std::string& topic, std::vector<zmq::message_t>& parts) {
    if (parts.size() < 4 || parts.size() > MAX_PARTS || parts[1].size() > MAX_META_BYTES)
        throw std::runtime_error("not an image");
    // Without limits msgpack takes as much memory as a few bytes claim.
    const msgpack::unpack_limit limit(64, 64, MAX_META_BYTES, MAX_META_BYTES, MAX_META_BYTES, 8);
    const auto unpacked =
        msgpack::unpack(parts[1].data<char>(), parts[1].size(), nullptr, nullptr, limit);
    const auto meta = unpacked.get().as<std::map<std::string, msgpack::object>>();

    const bool depth = topic == DEPTH;
    if (meta.at("v").as<std::string>().rfind("1.", 0) != 0 ||
        meta.at("encoding").as<std::string>() != (depth ? "32FC1" : "rgba8") ||
        meta.at("dtype").as<std::string>() != (depth ? "float32" : "uint8"))
        throw std::runtime_error("another protocol or encoding");

    Message message;
    message.session = meta.at("session").as<std::string>();
    message.epoch = meta.at("epoch").as<std::int64_t>();
    message.seq = meta.at("seq").as<std::int64_t>();
    message.stamp_ns = meta.at("stamp_ns").as<std::int64_t>();
    message.metric = meta.count("units") == 0;

    const auto shape = meta.at("shape").as<std::vector<std::int64_t>>();
    if (shape.size() != (depth ? 2 : 3) || (!depth && shape[2] != 4))
        throw std::runtime_error("another shape");
    message.height = shape[0];
    message.width = shape[1];
    if (std::min(message.height, message.width) < 1 || std::max(message.height, message.width) > MAX_SIDE)
        throw std::runtime_error("an impossible size");
    message.data = std::move(parts[3]);
    if (message.data.size() != static_cast<std::size_t>(message.height * message.width * 4))
        throw std::runtime_error("fewer or more bytes than the shape claims");
    return message;
}

// The newest messages of one topic, and whether they may be shown as new.
class Topic {
public:
    void add(Message message) {
        if (!kept_.empty()) {
            const Message& last = kept_.back();
            const bool same = message.session == last.session && message.epoch == last.epoch;
            if (same && message.seq <= last.seq) return;  // a last value, sent again
            if (!same) {  // stamps of another session or epoch must not be compared
                kept_.clear();
                window_.clear();
            }
        }
        window_.emplace_back(message.seq, message.stamp_ns);
        if (window_.size() > WINDOW) window_.pop_front();
        kept_.push_back(std::move(message));
        if (kept_.size() > KEPT) kept_.pop_front();
    }

    const Message* at(std::int64_t stamp_ns) const {
        for (const Message& message : kept_)
            if (message.stamp_ns == stamp_ns) return &message;
        return nullptr;
    }

    const Message* newest() const { return kept_.empty() ? nullptr : &kept_.back(); }

    // The third reason of wire.md, that the sender says so, is not looked at: a node that does not run sends no
    // frames, which the age shows.
    std::optional<std::string> stale() const {
        if (kept_.empty()) return "nothing received";
        const double age = (now_ns() - kept_.back().stamp_ns) * 1e-9;
        if (age > std::min(STALE_AFTER, STALE_PERIODS * period())) return "too old: " + std::to_string(age) + " s";
        if (rate() < MIN_RATE) return "too few messages arrive";
        return std::nullopt;
    }

private:
    double period() const {  // s between two messages of the sender: the median
        std::vector<double> steps;
        for (std::size_t i = 1; i < window_.size(); ++i)
            steps.push_back((window_[i].second - window_[i - 1].second) * 1e-9 /
                            static_cast<double>(window_[i].first - window_[i - 1].first));
        if (steps.empty()) return UNKNOWN_PERIOD;
        const auto middle = steps.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2);
        std::nth_element(steps.begin(), middle, steps.end());
        return std::max(*middle, 1e-3);
    }

    double rate() const {
        if (window_.size() < 2) return 1;
        return static_cast<double>(window_.size() - 1) /
               static_cast<double>(window_.back().first - window_.front().first);
    }

    std::deque<Message> kept_;
    std::deque<std::pair<std::int64_t, std::int64_t>> window_;  // seq, stamp_ns
};

// In place of drawing.
void show(const Message& image, const Message& depth) {
    const auto centre = static_cast<std::size_t>(depth.height / 2 * depth.width + depth.width / 2);
    const float metres = float_at(depth.data, centre);
    const auto* pixel = image.data.data<unsigned char>() + 4 * centre;
    std::cout << "stamp_ns=" << depth.stamp_ns << " age_ms=" << (now_ns() - depth.stamp_ns) / 1000000
              << " shape=" << depth.height << 'x' << depth.width << (depth.metric ? " depth_mm=" : " depth_no_unit=");
    if (std::isnan(metres))
        std::cout << "unknown";
    else
        std::cout << (depth.metric ? 1000 * metres : metres);
    std::cout << " rgba=" << +pixel[0] << ',' << +pixel[1] << ',' << +pixel[2] << ',' << +pixel[3]
              << std::endl;
}

void run(const std::string& endpoint, long frames) {
    zmq::context_t context;
    zmq::socket_t socket(context, zmq::socket_type::sub);
    socket.set(zmq::sockopt::maxmsgsize, MAX_PART_BYTES);
    socket.set(zmq::sockopt::rcvhwm, 8);
    socket.set(zmq::sockopt::heartbeat_ivl, 2000);  // also a node whose machine lost power is found again
    socket.set(zmq::sockopt::heartbeat_timeout, 6000);
    socket.set(zmq::sockopt::rcvtimeo, 100);
    socket.set(zmq::sockopt::linger, 0);
    socket.set(zmq::sockopt::subscribe, IMAGE);
    socket.set(zmq::sockopt::subscribe, DEPTH);
    socket.connect(endpoint);

    Topic images, depths;
    std::int64_t shown = 0;
    bool said_stale = false;
    while (frames > 0) {
        std::vector<zmq::message_t> parts;
        if (zmq::recv_multipart(socket, std::back_inserter(parts))) {
            const std::string name = parts[0].to_string();
            try {
                if (name == IMAGE) images.add(decode(name, parts));
                if (name == DEPTH) depths.add(decode(name, parts));
            } catch (const std::exception& error) {
                std::cerr << "left out: " << error.what() << '\n';
            }
        }
        const auto stale = std::max(images.stale(), depths.stale());  // an empty one is the smallest
        if (stale) {  // draw nothing: what is on the screen must not look like now
            if (!said_stale) std::cout << "stale: " << *stale << std::endl;
            said_stale = true;
            continue;
        }
        const Message* depth = depths.newest();
        const Message* image = images.at(depth->stamp_ns);
        if (image == nullptr || depth->stamp_ns == shown) continue;
        if (image->session != depth->session || image->epoch != depth->epoch) continue;
        if (image->height != depth->height || image->width != depth->width) continue;
        show(*image, *depth);
        shown = depth->stamp_ns;
        said_stale = false;
        --frames;
    }
}

}  // namespace

int main(int argc, char** argv) {
    const std::string endpoint = argc > 1 ? argv[1] : "tcp://127.0.0.1:5556";
    const long frames = argc > 2 ? std::strtol(argv[2], nullptr, 10) : std::numeric_limits<long>::max();
    try {
        run(endpoint, frames);
    } catch (const std::exception& error) {  // a malformed endpoint, for example
        std::cerr << "error: " << endpoint << ": " << error.what() << '\n';
        return 1;
    }
}
