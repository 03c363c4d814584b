// Reads a Prophesee EVK4, or a board like it, by OpenEB's own classes: discovery, device, facilities, stream, decoder.
//
//     client COUNT TIMEOUT_S OUT.bin [FORMAT [VENDOR PRODUCT]]
//
// FORMAT is EVT3, EVT21, or EVT2 of a GenX320; VENDOR and PRODUCT, in hexadecimal digits, are those of a board that OpenEB
// does not list itself, and that its maker opens by a plug-in of its own. The anti-flicker filter and the trigger input
// are switched on; so are, of a GenX320, the noise filter, the crop with a new origin, the rate control and the mask of a
// pixel. Of the others four biases and the window are changed and set back while they stream.
//
// Writes each event as t (int64, us), x, y (uint16), polarity (uint8), 13 bytes, to OUT.bin, has OpenEB record the same
// stream to OUT.bin.raw, and prints what it saw as JSON.

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include "boards/treuzell/tz_camera_discovery.h"
#include "metavision/hal/device/device.h"
#include "metavision/hal/facilities/i_antiflicker_module.h"
#include "metavision/hal/facilities/i_camera_synchronization.h"
#include "metavision/hal/facilities/i_digital_crop.h"
#include "metavision/hal/facilities/i_digital_event_mask.h"
#include "metavision/hal/facilities/i_erc_module.h"
#include "metavision/hal/facilities/i_event_decoder.h"
#include "metavision/hal/facilities/i_event_rate_activity_filter_module.h"
#include "metavision/hal/facilities/i_events_stream.h"
#include "metavision/hal/facilities/i_events_stream_decoder.h"
#include "metavision/hal/facilities/i_geometry.h"
#include "metavision/hal/facilities/i_hal_software_info.h"
#include "metavision/hal/facilities/i_hw_identification.h"
#include "metavision/hal/facilities/i_ll_biases.h"
#include "metavision/hal/facilities/i_monitoring.h"
#include "metavision/hal/facilities/i_plugin_software_info.h"
#include "metavision/hal/facilities/i_roi.h"
#include "metavision/hal/facilities/i_trigger_in.h"
#include "metavision/hal/utils/device_builder.h"
#include "metavision/hal/utils/device_config.h"
#include "metavision/hal/utils/hal_software_info.h"
#include "metavision/sdk/base/events/event_cd.h"
#include "metavision/sdk/base/events/event_ext_trigger.h"

using namespace Metavision;

namespace {

const I_ROI::Window large_window(200, 100, 800, 500), vga_window(100, 60, 400, 300), small_window(50, 40, 200, 250);
I_ROI::Window window = large_window;
constexpr std::uint32_t masked_x = 100, masked_y = 120, events_in_100_us = 20;

void append(std::FILE *out, const EventCD &event) {
    const std::int64_t t       = event.t;
    const std::uint16_t xy[2]  = {event.x, event.y};
    const std::uint8_t is_on   = event.p != 0;
    std::fwrite(&t, sizeof t, 1, out);
    std::fwrite(xy, sizeof xy, 1, out);
    std::fwrite(&is_on, 1, 1, out);
}

std::unique_ptr<Device> open_camera(const std::string &serial, const std::string &format, TzCameraDiscovery &discovery) {
    SoftwareInfo none(0, 0, 0, "", "", "", "");
    DeviceBuilder builder(std::make_unique<I_HALSoftwareInfo>(get_hal_software_info()),
                          std::make_unique<I_PluginSoftwareInfo>("test", "test", none));
    DeviceConfig config;
    config.set_format(format);
    if (!discovery.discover(builder, serial, config)) {
        return nullptr;
    }
    return builder();
}

template <typename Value>
std::string number_or_null(Value value) {
    try {
        return std::to_string(value());
    } catch (const std::exception &) { // a Gen4.1 has no thermometer and no dead time, a Gen3.1 no dead time
        return "null";
    }
}

bool select_on_genx320(Device &device) {
    auto *noise = device.get_facility<I_EventRateActivityFilterModule>();
    auto *crop  = device.get_facility<I_DigitalCrop>();
    auto *rate  = device.get_facility<I_ErcModule>();
    bool done   = noise->enable(true) && noise->is_enabled();
    done        = crop->set_window_region({60, 50, 239, 279}, true) && crop->enable(true) && done;
    done        = rate->set_cd_event_count(events_in_100_us) && rate->enable(true) && rate->is_enabled() && done;
    return device.get_facility<I_DigitalEventMask>()->get_pixel_masks()[0]->set_mask(masked_x, masked_y, true) && done;
}

void set_window(Device &device, int width) {
    auto *roi = device.get_facility<I_ROI>();
    roi->set_window(I_ROI::Window(window.x, window.y, width, window.height));
    if (device.get_facility<I_Geometry>()->get_width() == 640) {
        roi->enable(true); // of a Gen3.1 set_window only writes the registers
    }
}

// Makes the next change of settings, of a bias and of the window, when the stream has come so far; the last is undone.
void change(Device &device, int step) {
    auto *biases = device.get_facility<I_LL_Biases>();
    if (step == 1 || step == 2) {
        const int by = step == 1 ? -1 : 1; // downwards, as a Gen4.1 cannot go further up from where it is
        for (const auto *name : {"bias_diff_on", "bias_diff_off", "bias_fo", "bias_refr"}) {
            biases->set(name, biases->get(name) + by);
        }
    } else {
        set_window(device, step == 3 ? window.width / 2 : window.width);
    }
}

std::int64_t read_events(Device &device, std::int64_t count, double timeout_s, std::FILE *out, std::string &triggers,
                         int changes) {
    auto *edges = device.get_facility<I_EventDecoder<EventExtTrigger>>();
    edges->add_event_buffer_callback([&](const EventExtTrigger *begin, const EventExtTrigger *end) {
        for (; begin != end; ++begin) {
            triggers += (triggers.empty() ? "[" : ", [") + std::to_string(begin->t) + ", " + std::to_string(begin->p) + "]";
        }
    });
    int steps_done = 0;
    auto *stream  = device.get_facility<I_EventsStream>();
    auto *decoder = device.get_facility<I_EventsStreamDecoder>();
    auto *events  = device.get_facility<I_EventDecoder<EventCD>>();
    std::int64_t seen = 0;
    events->add_event_buffer_callback([&](const EventCD *begin, const EventCD *end) {
        for (; begin != end; ++begin, ++seen) {
            append(out, *begin);
        }
    });
    const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(timeout_s);
    stream->start();
    // A guest that stood still has many events in one buffer: it reads on until each change is made.
    while ((seen < count || steps_done < changes) && std::chrono::steady_clock::now() < end &&
           stream->wait_next_buffer() >= 0) {
        auto data = stream->get_latest_raw_data();
        if (data) {
            decoder->decode(data.data(), data.data() + data.size());
        }
        if (steps_done < changes && seen > (steps_done + 1) * count / 6) {
            change(device, ++steps_done);
        }
    }
    stream->stop();
    return steps_done == changes ? seen : 0;
}

} // namespace

int main(int argc, char **argv) {
    if (argc != 4 && argc != 5 && argc != 7) {
        return 2;
    }
    try {
        const std::string format = argc > 4 ? argv[4] : "EVT3";
        const auto vendor        = argc > 5 ? std::strtoul(argv[5], nullptr, 16) : 0x04b4;
        const auto product       = argc > 5 ? std::strtoul(argv[6], nullptr, 16) : 0x00f5;
        TzCameraDiscovery discovery;
        discovery.add_usb_id(vendor, product, 0x19);
        const auto serials = discovery.list();
        if (serials.size() != 1) {
            std::cerr << serials.size() << " cameras found\n";
            return 1;
        }
        auto device = open_camera(serials.front(), format, discovery);
        if (!device) {
            std::cerr << "the camera cannot be built\n";
            return 1;
        }
        auto *biases = device->get_facility<I_LL_Biases>();
        biases->set("bias_diff_on", biases->get("bias_diff_on") + 25);
        const int width     = device->get_facility<I_Geometry>()->get_width();
        const bool is_small = width == 320;
        window              = is_small ? small_window : width == 640 ? vga_window : large_window;
        device->get_facility<I_ROI>()->set_window(window);
        device->get_facility<I_ROI>()->enable(true);
        device->get_facility<I_TriggerIn>()->enable(I_TriggerIn::Channel::Main);
        auto *anti_flicker = device->get_facility<I_AntiFlickerModule>();
        if (anti_flicker) { // a Gen3.1 has none
            anti_flicker->enable(true);
        }
        const bool is_filtered = anti_flicker && anti_flicker->is_enabled(); // a Gen4.1's stop switches it off
        if (is_small && !select_on_genx320(*device)) {
            std::cerr << "a selection was refused\n";
            return 1;
        }
        auto *monitoring = device->get_facility<I_Monitoring>();
        std::FILE *out   = std::fopen(argv[3], "wb");
        auto *stream     = device->get_facility<I_EventsStream>();
        if (!stream->log_raw_data(std::string(argv[3]) + ".raw")) {
            std::cerr << "the stream cannot be recorded\n";
            return 1;
        }
        std::string triggers;
        const auto seen  = read_events(*device, std::atoll(argv[1]), std::atof(argv[2]), out, triggers, is_small ? 0 : 4);
        std::fclose(out);
        stream->stop_log_raw_data();
        std::cout << "{\"serial\": \"" << serials.front() << "\", \"events\": " << seen
                  << ", \"sensor\": \"" << device->get_facility<I_HW_Identification>()->get_sensor_info().name_ << "\""
                  << ", \"bias_diff_on\": " << biases->get("bias_diff_on")
                  << ", \"changed\": " << (seen ? "true" : "false") << ", \"triggers\": [" << triggers << "]"
                  << ", \"word_bytes\": " << int(device->get_facility<I_EventsStreamDecoder>()->get_raw_event_size_bytes())
                  << ", \"anti_flicker\": " << (is_filtered ? "true" : "false")
                  << ", \"celsius\": " << number_or_null([&] { return monitoring->get_temperature(); })
                  << ", \"lux\": " << number_or_null([&] { return monitoring->get_illumination(); })
                  << ", \"dead_time_us\": " << number_or_null([&] { return monitoring->get_pixel_dead_time(); }) << "}"
                  << std::endl;
    } catch (const std::exception &error) {
        std::cerr << error.what() << std::endl;
        return 1;
    }
    return 0;
}
