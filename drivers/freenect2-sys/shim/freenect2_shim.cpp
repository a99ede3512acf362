// The table of freenect2_shim.h over libfreenect2, by its pipeline that hands raw packets on.

#include "freenect2_shim.h"

#include <cstring>
#include <exception>
#include <memory>
#include <mutex>
#include <string>

#include <libfreenect2/frame_listener.hpp>
#include <libfreenect2/libfreenect2.hpp>
#include <libfreenect2/logger.h>
#include <libfreenect2/packet_pipeline.h>

namespace {

// Errors may be logged by any thread of the library.
std::mutex error_mutex;
std::string error_text;

// What comes first tells the cause; what follows from it is left out beyond so many bytes.
const size_t max_error_bytes = 500;

// A call begins: what was logged before has nothing to do with it.
void forget_errors() {
    std::lock_guard<std::mutex> lock(error_mutex);
    error_text.clear();
}

void add_error(const std::string &text) {
    std::lock_guard<std::mutex> lock(error_mutex);
    if (!error_text.empty())
        error_text += "; ";
    error_text += text;
    if (error_text.size() > max_error_bytes)
        error_text.resize(max_error_bytes);
}

// Keeps the errors of a call and prints nothing: standard output belongs to the program.
class ErrorKeeper : public libfreenect2::Logger {
public:
    ErrorKeeper() { level_ = Error; }
    void log(Level level, const std::string &message) override {
        if (level == Error)
            add_error(message);
    }
};

f2shim_status copy_text(const std::string &text, char *buffer, size_t capacity) {
    if (text.size() + 1 > capacity)
        return F2SHIM_TOO_SMALL;
    std::memcpy(buffer, text.c_str(), text.size() + 1);
    return F2SHIM_OK;
}

// Runs `body`, turning whatever it throws into a status.
template <typename Body> f2shim_status guarded(Body body) {
    try {
        return body();
    } catch (const std::exception &error) {
        try {
            add_error(error.what());
        } catch (...) {
        }
    } catch (...) {
    }
    return F2SHIM_FAILED;
}

// Hands raw packets on. The library owns every frame, since each answer is false: the IR frame shares its memory with
// another, and a depth frame that were kept would have to be deleted on this side.
class PacketListener : public libfreenect2::FrameListener {
public:
    f2shim_packet_callback callback = nullptr;
    void *user = nullptr;

    bool onNewFrame(libfreenect2::Frame::Type type, libfreenect2::Frame *frame) override {
        if (type == libfreenect2::Frame::Depth && callback) {
            // A raw frame keeps its length in bytes_per_pixel.
            const f2shim_packet packet = {frame->data, frame->bytes_per_pixel, frame->timestamp, frame->sequence,
                                          frame->status};
            callback(user, &packet);
        }
        return false;
    }
};

} // namespace

struct f2shim_context {
    libfreenect2::Freenect2 library;
    int n_devices = 0;
};

struct f2shim_device {
    // Owned by the library's device, and freed with it.
    libfreenect2::DumpPacketPipeline *pipeline = nullptr;
    libfreenect2::Freenect2Device *device = nullptr;
    PacketListener listener;
    bool streaming = false;
};

namespace {

f2shim_status context_create(f2shim_context **out) {
    return guarded([&] {
        // The library takes the logger over. Replacing it would free it while threads of other contexts log.
        static std::once_flag once;
        std::call_once(once, [] { libfreenect2::setGlobalLogger(new ErrorKeeper()); });
        *out = new f2shim_context();
        return F2SHIM_OK;
    });
}

void context_destroy(f2shim_context *context) {
    guarded([&] {
        delete context;
        return F2SHIM_OK;
    });
}

f2shim_status enumerate(f2shim_context *context, uint32_t *n_devices) {
    return guarded([&] {
        forget_errors();
        const int n = context->library.enumerateDevices();
        context->n_devices = n > 0 ? n : 0;
        *n_devices = static_cast<uint32_t>(context->n_devices);
        return F2SHIM_OK;
    });
}

f2shim_status serial(f2shim_context *context, uint32_t index, char *buffer, size_t capacity) {
    return guarded([&]() -> f2shim_status {
        if (index >= static_cast<uint32_t>(context->n_devices))
            return F2SHIM_NOT_FOUND;
        return copy_text(context->library.getDeviceSerialNumber(static_cast<int>(index)), buffer, capacity);
    });
}

f2shim_status device_open(f2shim_context *context, const char *serial, f2shim_device **out) {
    return guarded([&]() -> f2shim_status {
        forget_errors();
        std::unique_ptr<f2shim_device> opened(new f2shim_device());
        // openDevice frees the pipeline itself when it fails.
        opened->pipeline = new libfreenect2::DumpPacketPipeline();
        opened->device = context->library.openDevice(std::string(serial), opened->pipeline);
        if (!opened->device)
            return F2SHIM_FAILED;
        // By index after a reset, the library may have opened another device.
        if (opened->device->getSerialNumber() != serial) {
            opened->device->close();
            delete opened->device;
            return F2SHIM_NOT_FOUND;
        }
        *out = opened.release();
        return F2SHIM_OK;
    });
}

f2shim_status device_start(f2shim_device *device, f2shim_packet_callback callback, void *user) {
    return guarded([&]() -> f2shim_status {
        if (device->streaming)
            return F2SHIM_WRONG_STATE;
        forget_errors();
        device->listener.callback = callback;
        device->listener.user = user;
        device->device->setIrAndDepthFrameListener(&device->listener);
        // Streaming from the first call on, since a start that failed half way must be stopped too.
        device->streaming = true;
        return device->device->startStreams(false, true) ? F2SHIM_OK : F2SHIM_FAILED;
    });
}

f2shim_status device_stop(f2shim_device *device) {
    return guarded([&]() -> f2shim_status {
        if (!device->streaming)
            return F2SHIM_WRONG_STATE;
        device->streaming = false;
        return device->device->stop() ? F2SHIM_OK : F2SHIM_FAILED;
    });
}

void device_close(f2shim_device *device) {
    guarded([&]() -> f2shim_status {
        std::unique_ptr<f2shim_device> closing(device);
        if (closing->streaming)
            closing->device->stop();
        closing->device->close();
        // The packet processor's thread ends with the device: only then may the listener go.
        delete closing->device;
        return F2SHIM_OK;
    });
}

f2shim_status device_firmware(f2shim_device *device, char *buffer, size_t capacity) {
    return guarded([&]() -> f2shim_status {
        if (!device->streaming)
            return F2SHIM_WRONG_STATE;
        return copy_text(device->device->getFirmwareVersion(), buffer, capacity);
    });
}

f2shim_status device_ir_parameters(f2shim_device *device, f2shim_ir_parameters *out) {
    return guarded([&]() -> f2shim_status {
        if (!device->streaming)
            return F2SHIM_WRONG_STATE;
        const libfreenect2::Freenect2Device::IrCameraParams p = device->device->getIrCameraParams();
        *out = {p.fx, p.fy, p.cx, p.cy, p.k1, p.k2, p.k3, p.p1, p.p2};
        return F2SHIM_OK;
    });
}

f2shim_status device_p0_tables(f2shim_device *device, uint8_t *buffer, size_t capacity, size_t *length) {
    return guarded([&]() -> f2shim_status {
        if (!device->streaming)
            return F2SHIM_WRONG_STATE;
        *length = 0;
        const unsigned char *tables = device->pipeline->getDepthP0Tables(length);
        if (!tables)
            return F2SHIM_FAILED;
        if (*length > capacity)
            return F2SHIM_TOO_SMALL;
        std::memcpy(buffer, tables, *length);
        return F2SHIM_OK;
    });
}

f2shim_status last_error(char *buffer, size_t capacity) {
    return guarded([&]() -> f2shim_status {
        if (capacity == 0)
            return F2SHIM_TOO_SMALL;
        std::lock_guard<std::mutex> lock(error_mutex);
        return copy_text(error_text.substr(0, capacity - 1), buffer, capacity);
    });
}

} // namespace

const f2shim_api *f2shim_libfreenect2(void) {
    static const f2shim_api api = {
        context_create, context_destroy, enumerate,    serial,          device_open,          device_start,
        device_stop,    device_close,    device_firmware, device_ir_parameters, device_p0_tables, last_error,
    };
    return &api;
}
