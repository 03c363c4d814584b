/* libcaer, used directly: events, edges of the external input, inertial samples and frames of a camera, as it gives them.

       client davis|dvxplorer COUNT TIMEOUT_S OUT

   Takes COUNT events and writes, in the byte order of the machine and without gaps,

       OUT.events    t (uint64, us), x, y (uint16), on (uint8)
       OUT.triggers  t (uint64, us), kind (uint8: 2 rising edge, 3 falling edge, 4 pulse)
       OUT.imu       t (uint64, us), acceleration x, y, z in g, temperature in degrees Celsius, rate x, y, z in deg/s
                     (float32)
       OUT.frames    t (uint64, us) of the start of the exposure, pixels (uint16) row by row

   The last line printed is a JSON object. The exit status is 1 when no camera is there, 3 when time runs out. */
#include <libcaer/devices/davis.h>
#include <libcaer/devices/dvxplorer.h>
#include <libcaer/libcaer.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { EVENTS, TRIGGERS, IMU, FRAMES, FILES };

static FILE *out[FILES];
static long long counts[FILES];
static atomic_bool is_gone;

static void gone(void *unused) {
    (void) unused;
    atomic_store(&is_gone, true);
}

static void put(int file, uint64_t t, const void *rest, size_t size) {
    fwrite(&t, sizeof t, 1, out[file]);
    fwrite(rest, size, 1, out[file]);
    counts[file]++;
}

static void put_events(caerPolarityEventPacketConst packet) {
    CAER_POLARITY_CONST_ITERATOR_VALID_START(packet)
    const uint16_t x = caerPolarityEventGetX(caerPolarityIteratorElement);
    const uint16_t y = caerPolarityEventGetY(caerPolarityIteratorElement);
    uint8_t rest[5];
    memcpy(rest, &x, 2);
    memcpy(rest + 2, &y, 2);
    rest[4] = caerPolarityEventGetPolarity(caerPolarityIteratorElement);
    put(EVENTS, caerPolarityEventGetTimestamp64(caerPolarityIteratorElement, packet), rest, sizeof rest);
    CAER_POLARITY_ITERATOR_VALID_END
}

static void put_triggers(caerSpecialEventPacketConst packet) {
    CAER_SPECIAL_CONST_ITERATOR_VALID_START(packet)
    const uint8_t kind = caerSpecialEventGetType(caerSpecialIteratorElement);
    if (kind >= EXTERNAL_INPUT_RISING_EDGE && kind <= EXTERNAL_INPUT_PULSE) {
        put(TRIGGERS, caerSpecialEventGetTimestamp64(caerSpecialIteratorElement, packet), &kind, 1);
    }
    CAER_SPECIAL_ITERATOR_VALID_END
}

static void put_samples(caerIMU6EventPacketConst packet) {
    CAER_IMU6_CONST_ITERATOR_VALID_START(packet)
    caerIMU6EventConst one = caerIMU6IteratorElement;
    const float values[] = {
        caerIMU6EventGetAccelX(one), caerIMU6EventGetAccelY(one), caerIMU6EventGetAccelZ(one), caerIMU6EventGetTemp(one),
        caerIMU6EventGetGyroX(one), caerIMU6EventGetGyroY(one), caerIMU6EventGetGyroZ(one),
    };
    put(IMU, caerIMU6EventGetTimestamp64(one, packet), values, sizeof values);
    CAER_IMU6_ITERATOR_VALID_END
}

static void put_frames(caerFrameEventPacketConst packet) {
    CAER_FRAME_CONST_ITERATOR_VALID_START(packet)
    caerFrameEventConst one = caerFrameIteratorElement;
    const size_t pixels     = (size_t) caerFrameEventGetLengthX(one) * (size_t) caerFrameEventGetLengthY(one);
    put(FRAMES, caerFrameEventGetTSStartOfExposure64(one, packet), caerFrameEventGetPixelArrayUnsafeConst(one),
        pixels * sizeof(uint16_t));
    CAER_FRAME_ITERATOR_VALID_END
}

static void take(caerEventPacketContainerConst container) {
    for (int32_t i = 0; i < caerEventPacketContainerGetEventPacketsNumber(container); i++) {
        caerEventPacketHeaderConst packet = caerEventPacketContainerGetEventPacketConst(container, i);
        if (packet == NULL) {
            continue;
        }
        switch (caerEventPacketHeaderGetEventType(packet)) {
            case POLARITY_EVENT: put_events((caerPolarityEventPacketConst) packet); break;
            case SPECIAL_EVENT: put_triggers((caerSpecialEventPacketConst) packet); break;
            case IMU6_EVENT: put_samples((caerIMU6EventPacketConst) packet); break;
            case FRAME_EVENT: put_frames((caerFrameEventPacketConst) packet); break;
        }
    }
}

static void detect_edges(caerDeviceHandle camera, bool is_davis) {
    const int8_t module = is_davis ? DAVIS_CONFIG_EXTINPUT : DVX_EXTINPUT; /* the parameters have equal numbers */
    caerDeviceConfigSet(camera, module, DVX_EXTINPUT_DETECT_RISING_EDGES, true);
    caerDeviceConfigSet(camera, module, DVX_EXTINPUT_DETECT_FALLING_EDGES, true);
    caerDeviceConfigSet(camera, module, DVX_EXTINPUT_DETECT_PULSES, true);
    caerDeviceConfigSet(camera, module, DVX_EXTINPUT_RUN_DETECTOR, true);
}

static bool open_files(const char *name) {
    const char *ends[FILES] = {"events", "triggers", "imu", "frames"};
    char path[1024];
    for (int i = 0; i < FILES; i++) {
        snprintf(path, sizeof path, "%s.%s", name, ends[i]);
        if ((out[i] = fopen(path, "wb")) == NULL) {
            return false;
        }
    }
    return true;
}

static void read_until(caerDeviceHandle camera, long long count, time_t end) {
    while (counts[EVENTS] < count && time(NULL) < end && !atomic_load(&is_gone)) {
        caerEventPacketContainer container = caerDeviceDataGet(camera);
        if (container == NULL) {
            nanosleep(&(struct timespec) {.tv_nsec = 1000000}, NULL);
            continue;
        }
        take(container);
        caerEventPacketContainerFree(container);
    }
}

static void describe(caerDeviceHandle camera, bool is_davis) {
    struct caer_davis_info davis = {0};
    struct caer_dvx_info dvx     = {0};
    if (is_davis) {
        davis = caerDavisInfoGet(camera);
    } else {
        dvx = caerDVXplorerInfoGet(camera);
    }
    printf("{\"serial\": \"%s\", \"firmware\": %d, \"logic\": %d, \"size\": [%d, %d], \"running\": %s, \"events\": %lld, "
           "\"triggers\": %lld, \"imu\": %lld}\n",
        is_davis ? davis.deviceSerialNumber : dvx.deviceSerialNumber,
        is_davis ? davis.firmwareVersion : dvx.firmwareVersion, is_davis ? davis.logicVersion : dvx.logicVersion,
        is_davis ? davis.dvsSizeX : dvx.dvsSizeX, is_davis ? davis.dvsSizeY : dvx.dvsSizeY,
        atomic_load(&is_gone) ? "false" : "true", counts[EVENTS], counts[TRIGGERS], counts[IMU]);
}

int main(int argc, char **argv) {
    if (argc != 5 || !open_files(argv[4])) {
        return 2;
    }
    const bool is_davis = strcmp(argv[1], "davis") == 0;
    const time_t end    = time(NULL) + atoi(argv[3]);
    caerDeviceHandle camera = caerDeviceOpen(1, is_davis ? CAER_DEVICE_DAVIS : CAER_DEVICE_DVXPLORER, 0, 0, NULL);
    if (camera == NULL) {
        return 1;
    }
    caerDeviceSendDefaultConfig(camera);
    /* The library loses what does not fit its queue; a machine that QEMU translates may pause for seconds. */
    caerDeviceConfigSet(camera, CAER_HOST_CONFIG_DATAEXCHANGE, CAER_HOST_CONFIG_DATAEXCHANGE_BUFFER_SIZE, 8192);
    detect_edges(camera, is_davis);
    if (!caerDeviceDataStart(camera, NULL, NULL, NULL, &gone, NULL)) {
        return 1;
    }
    read_until(camera, atoll(argv[2]), end);
    describe(camera, is_davis);
    caerDeviceDataStop(camera);
    caerDeviceClose(&camera);
    for (int i = 0; i < FILES; i++) {
        fclose(out[i]);
    }
    return counts[EVENTS] < atoll(argv[2]) ? 3 : 0;
}
