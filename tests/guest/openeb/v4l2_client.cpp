// Reads a sensor on V4L2 by OpenEB's own classes, as client.cpp reads a camera on USB:
//
//     v4l2_client COUNT TIMEOUT_S OUT.bin
//
// The format is the one that is set on the video device, as OpenEB expects it. A bias and a window are set before the
// stream; in the last fifth of the stream the window becomes smaller and the rate control is switched on, and it is read for long enough
// to see both. Writes each event as client.cpp does, has OpenEB record the stream to OUT.bin.raw, and prints what it saw
// as JSON.

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <iostream>
#include <memory>
#include <string>

#include "boards/v4l2/v4l2_camera_discovery.h"
#include "metavision/hal/device/device.h"
#include "metavision/hal/facilities/i_erc_module.h"
#include "metavision/hal/facilities/i_event_decoder.h"
#include "metavision/hal/facilities/i_events_stream.h"
#include "metavision/hal/facilities/i_events_stream_decoder.h"
#include "metavision/hal/facilities/i_geometry.h"
#include "metavision/hal/facilities/i_hal_software_info.h"
#include "metavision/hal/facilities/i_hw_identification.h"
#include "metavision/hal/facilities/i_ll_biases.h"
#include "metavision/hal/facilities/i_plugin_software_info.h"
#include "metavision/hal/facilities/i_roi.h"
#include "metavision/hal/utils/device_builder.h"
#include "metavision/hal/utils/device_config.h"
#include "metavision/hal/utils/hal_software_info.h"
#include "metavision/sdk/base/events/event_cd.h"

using namespace Metavision;

namespace {

constexpr int bias_offset = 5;
constexpr std::uint32_t events_per_s = 20'000;
constexpr std::int64_t after_changes_us = 4'000'000; // beside other work the decoder is seconds behind the camera

void append(std::FILE *out, const EventCD &event) {
    const std::int64_t t      = event.t;
    const std::uint16_t xy[2] = {event.x, event.y};
    const std::uint8_t is_on  = event.p != 0;
    std::fwrite(&t, sizeof t, 1, out);
    std::fwrite(xy, sizeof xy, 1, out);
    std::fwrite(&is_on, 1, 1, out);
}

std::int64_t read_events(Device &device, std::int64_t count, double timeout_s, std::FILE *out) {
    auto *stream  = device.get_facility<I_EventsStream>();
    auto *decoder = device.get_facility<I_EventsStreamDecoder>();
    std::int64_t seen = 0, last_us = 0, limited_from_us = -1;
    bool is_narrow = false;
    device.get_facility<I_EventDecoder<EventCD>>()->add_event_buffer_callback(
        [&](const EventCD *begin, const EventCD *end) {
            for (; begin != end; ++begin, ++seen) {
                append(out, *begin);
                last_us = begin->t;
            }
        });
    const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(timeout_s);
    const auto is_read = [&] {
        return seen >= count && limited_from_us >= 0 && last_us >= limited_from_us + after_changes_us;
    };
    stream->start();
    while (!is_read() && std::chrono::steady_clock::now() < end) {
        if (stream->wait_next_buffer() < 0) {
            if (seen) {
                break;
            }
            // OpenEB starts its thread before the stream, and the thread ends where it polls first: start once more.
            stream->stop();
            stream->start();
            continue;
        }
        auto data = stream->get_latest_raw_data();
        if (data) {
            decoder->decode(data.data(), data.data() + data.size());
        }
        if (!is_narrow && seen > count * 8 / 10) {
            const auto *size = device.get_facility<I_Geometry>();
            device.get_facility<I_ROI>()->set_window(I_ROI::Window(20, 30, size->get_width() / 2, size->get_height() / 2));
            is_narrow = true;
        } else if (limited_from_us < 0 && seen > count * 9 / 10) {
            device.get_facility<I_ErcModule>()->enable(true);
            limited_from_us = last_us;
        }
    }
    stream->stop();
    return seen;
}

} // namespace

int main(int argc, char **argv) {
    if (argc != 4) {
        return 2;
    }
    try {
        V4l2CameraDiscovery discovery;
        const auto serials = discovery.list();
        if (serials.size() != 1) {
            std::cerr << serials.size() << " cameras found\n";
            return 1;
        }
        SoftwareInfo none(0, 0, 0, "", "", "", "");
        DeviceBuilder builder(std::make_unique<I_HALSoftwareInfo>(get_hal_software_info()),
                              std::make_unique<I_PluginSoftwareInfo>("test", "test", none));
        if (!discovery.discover(builder, serials.front(), DeviceConfig())) {
            std::cerr << "the camera cannot be built\n";
            return 1;
        }
        auto device       = builder();
        auto *biases      = device->get_facility<I_LL_Biases>();
        const int initial = biases->get("bias_diff_on");
        biases->set("bias_diff_on", initial + bias_offset);
        device->get_facility<I_ErcModule>()->set_cd_event_count(events_per_s);
        const auto *size = device->get_facility<I_Geometry>();
        device->get_facility<I_ROI>()->set_window(I_ROI::Window(10, 20, size->get_width() - 20, size->get_height() - 40));
        device->get_facility<I_ROI>()->enable(true);
        std::FILE *out = std::fopen(argv[3], "wb");
        auto *stream   = device->get_facility<I_EventsStream>();
        if (!stream->log_raw_data(std::string(argv[3]) + ".raw")) {
            std::cerr << "the stream cannot be recorded\n";
            return 1;
        }
        const auto seen = read_events(*device, std::atoll(argv[1]), std::atof(argv[2]), out);
        std::fclose(out);
        stream->stop_log_raw_data();
        auto *about = device->get_facility<I_HW_Identification>();
        std::cout << "{\"serial\": \"" << about->get_serial() << "\", \"integrator\": \"" << about->get_integrator()
                  << "\", \"sensor\": \"" << about->get_sensor_info().name_ << "\", \"format\": \""
                  << about->get_current_data_encoding_format() << "\", \"events\": " << seen
                  << ", \"bias_before\": " << initial << ", \"bias_after\": " << biases->get("bias_diff_on")
                  << ", \"is_limited\": " << (device->get_facility<I_ErcModule>()->is_enabled() ? "true" : "false") << "}" << std::endl;
    } catch (const std::exception &error) {
        std::cerr << error.what() << std::endl;
        return 1;
    }
    return 0;
}
