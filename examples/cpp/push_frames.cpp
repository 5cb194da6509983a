// A sender in C++17, written from docs/inputs.md alone: hands stereo images in to a node with source.kind push.
//
//     push_frames [ENDPOINT] [FRAMES] [WIDTH] [HEIGHT]      default: tcp://127.0.0.1:5558, until Ctrl-C, 640 x 512
//
// Draws a moving pattern. Prints what the node answers when that changes.

#include <chrono>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <iostream>
#include <map>
#include <string>
#include <thread>
#include <vector>

#include <msgpack.hpp>
#include <zmq.hpp>
#include <zmq_addon.hpp>

namespace {

const std::string TYPE = "sensor_msgs/msg/Image";
const std::string TYPE_HASH = "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47";

std::int64_t now_ns() {
    const auto now = std::chrono::system_clock::now().time_since_epoch();
    return std::chrono::duration_cast<std::chrono::nanoseconds>(now).count();
}

// Little-endian CDR: every number is aligned to its size, counted from behind the four bytes of the head.
class Cdr {
public:
    std::string bytes{"\0\1\0\0", 4};

    void number(std::uint32_t value) {
        bytes.resize((bytes.size() + 3) / 4 * 4);
        for (int shift = 0; shift < 32; shift += 8) bytes += static_cast<char>(value >> shift & 0xff);
    }
    void text(const std::string& value) {
        number(static_cast<std::uint32_t>(value.size() + 1));
        bytes += value + '\0';
    }
    void byte(std::uint8_t value) { bytes += static_cast<char>(value); }
};

// All of a sensor_msgs/Image but its pixels, which are sent behind it.
std::string image_head(std::int64_t stamp_ns, std::uint32_t width, std::uint32_t height) {
    Cdr cdr;
    cdr.number(static_cast<std::uint32_t>(stamp_ns / 1'000'000'000));
    cdr.number(static_cast<std::uint32_t>(stamp_ns % 1'000'000'000));
    cdr.text("camera");
    cdr.number(height);
    cdr.number(width);
    cdr.text("rgb8");
    cdr.byte(0);  // not big-endian
    cdr.number(3 * width);
    cdr.number(3 * width * height);
    return cdr.bytes;
}

std::string meta(std::int64_t stamp_ns, std::int64_t seq, std::uint32_t width, std::uint32_t height) {
    msgpack::sbuffer buffer;
    msgpack::packer<msgpack::sbuffer> packer(buffer);
    packer.pack_map(14);
    const auto put = [&](const char* key, const auto& value) { packer.pack(std::string(key)), packer.pack(value); };
    put("v", std::string("1.0"));
    put("type", TYPE);
    put("type_hash", TYPE_HASH);
    put("seq", seq);
    put("frame_id", seq);
    put("stamp_ns", stamp_ns);  // when the image was taken
    put("publish_ns", now_ns());
    put("session", std::string("push_frames"));
    put("epoch", 0);
    put("step", 0);
    put("encoding", std::string("rgb8"));
    put("shape", std::vector<std::uint32_t>{height, width, 3});
    put("dtype", std::string("uint8"));
    put("dropped", 0);
    return {buffer.data(), buffer.size()};
}

void draw(std::vector<std::uint8_t>& picture, std::uint32_t width, std::uint32_t height, int phase) {
    for (std::uint32_t y = 0; y < height; ++y)
        for (std::uint32_t x = 0; x < width; ++x) {
            auto* pixel = &picture[3 * (y * width + x)];
            pixel[0] = static_cast<std::uint8_t>((x + phase) ^ y);
            pixel[1] = static_cast<std::uint8_t>((x + phase) * y / 64);
            pixel[2] = 60;
        }
}

void listen(zmq::socket_t& socket, std::string& said) {
    zmq::message_t answer;
    while (socket.recv(answer, zmq::recv_flags::dontwait)) {
        const auto unpacked = msgpack::unpack(answer.data<char>(), answer.size());
        const auto receipt = unpacked.get().as<std::map<std::string, msgpack::object>>();
        const auto& problem = receipt.at("problem");
        const std::string now = problem.is_nil() ? "all is well" : problem.as<std::string>();
        if (now != said) std::cout << receipt.at("taken").as<std::int64_t>() << " taken: " << now << std::endl;
        said = now;
    }
}

}  // namespace

int main(int argc, char** argv) {
    const std::string endpoint = argc > 1 ? argv[1] : "tcp://127.0.0.1:5558";
    const long frames = argc > 2 ? std::atol(argv[2]) : -1;
    const auto width = static_cast<std::uint32_t>(argc > 3 ? std::atoi(argv[3]) : 640);
    const auto height = static_cast<std::uint32_t>(argc > 4 ? std::atoi(argv[4]) : 512);

    zmq::context_t context;
    zmq::socket_t socket(context, zmq::socket_type::dealer);
    socket.set(zmq::sockopt::sndhwm, 4);  // two pairs: a node that is slow gets new ones, not old ones
    socket.set(zmq::sockopt::immediate, true);  // one that is away gets none, also once it is there
    socket.set(zmq::sockopt::linger, 500);
    socket.connect(endpoint);

    std::vector<std::uint8_t> picture(3 * static_cast<std::size_t>(width) * height);
    std::string said;
    auto due = std::chrono::steady_clock::now();
    for (std::int64_t seq = 1; frames < 0 || seq <= frames; ++seq) {
        const std::int64_t stamp_ns = now_ns();  // one for both eyes: it says which belong together
        for (const bool right : {false, true}) {
            draw(picture, width, height, static_cast<int>(seq) + 12 * right);
            const std::string topic = right ? "camera/right/image_raw" : "camera/left/image_raw";
            zmq::multipart_t message;
            message.addstr(topic);
            message.addstr(meta(stamp_ns, seq, width, height));
            message.addstr(image_head(stamp_ns, width, height));
            message.addmem(picture.data(), picture.size());
            message.send(socket, static_cast<int>(zmq::send_flags::dontwait));  // false: no node, or a full queue
        }
        listen(socket, said);
        due += std::chrono::milliseconds(33);
        std::this_thread::sleep_until(due);
    }
}
