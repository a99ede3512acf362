/* A plain C face of what Relief needs of libfreenect2: raw depth packets and the tables to decode them.
 *
 * An implementation is one table of functions. There are two: freenect2_shim.cpp over libfreenect2, and a stand-in of
 * Relief's tests, which plays synthesised packets. No exception leaves a function; every status is one of f2shim_status.
 *
 * Threads: the calls on one context and its devices must come from one thread at a time. The packet callback comes from
 * a thread of the implementation, and must not call any function of the table.
 */
#ifndef RELIEF_FREENECT2_SHIM_H
#define RELIEF_FREENECT2_SHIM_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* What became of a call. */
typedef uint32_t f2shim_status;
enum {
    F2SHIM_OK = 0,
    /* The library refused or threw; last_error says why. */
    F2SHIM_FAILED = 1,
    /* No device of that index or serial. */
    F2SHIM_NOT_FOUND = 2,
    /* The caller's buffer is too small. */
    F2SHIM_TOO_SMALL = 3,
    /* The device must be streaming for this, or must not be. */
    F2SHIM_WRONG_STATE = 4
};

/* A library context. */
typedef struct f2shim_context f2shim_context;
/* An open device. */
typedef struct f2shim_device f2shim_device;

/* The IR camera as the firmware has it: pixels of the mirrored image, pixel centres at halves. */
typedef struct f2shim_ir_parameters {
    float fx, fy, cx, cy, k1, k2, k3, p1, p2;
} f2shim_ir_parameters;

/* One raw packet. */
typedef struct f2shim_packet {
    /* The library's memory, valid during the callback alone. */
    const uint8_t *data;
    size_t length;
    /* Device clock, 0.125 ms. */
    uint32_t timestamp;
    uint32_t sequence;
    /* 0 if the library found nothing wrong. */
    uint32_t status;
} f2shim_packet;

/* Receives each packet; must return soon. `packet` and what it points to stay the library's. */
typedef void (*f2shim_packet_callback)(void *user, const f2shim_packet *packet);

typedef struct f2shim_api {
    /* Makes a context in *out, which the caller frees with context_destroy. */
    f2shim_status (*context_create)(f2shim_context **out);
    /* Frees a context; its devices must have been closed. */
    void (*context_destroy)(f2shim_context *context);
    /* Looks for devices and counts them. One that cannot be opened is left out; last_error says so. */
    f2shim_status (*enumerate)(f2shim_context *context, uint32_t *n_devices);
    /* Serial of a device of the last enumeration, zero-terminated, into the caller's `buffer`. */
    f2shim_status (*serial)(f2shim_context *context, uint32_t index, char *buffer, size_t capacity);
    /* Opens the device of a zero-terminated serial in *out, which the caller frees with device_close. */
    f2shim_status (*device_open)(f2shim_context *context, const char *serial, f2shim_device **out);
    /* Starts depth. `user` is handed to each callback and stays the caller's; it must live until device_stop or device_close
     * has returned. */
    f2shim_status (*device_start)(f2shim_device *device, f2shim_packet_callback callback, void *user);
    /* Stops depth; no callback runs after it has returned. FAILED if the device is gone; it is stopped even then. */
    f2shim_status (*device_stop)(f2shim_device *device);
    /* Stops depth if need be, closes and frees the device. */
    void (*device_close)(f2shim_device *device);
    /* Firmware of a streaming device, zero-terminated, into the caller's `buffer`. */
    f2shim_status (*device_firmware)(f2shim_device *device, char *buffer, size_t capacity);
    /* IR camera of a streaming device. */
    f2shim_status (*device_ir_parameters)(f2shim_device *device, f2shim_ir_parameters *out);
    /* The phase tables' response of a streaming device into the caller's `buffer`; *length is set even if it is too
     * small. */
    f2shim_status (*device_p0_tables)(f2shim_device *device, uint8_t *buffer, size_t capacity, size_t *length);
    /* The errors that were logged since the last enumerate, device_open or device_start began, the first of them first,
     * zero-terminated and cut to `capacity`, into the caller's `buffer`. May be called from any thread. */
    f2shim_status (*last_error)(char *buffer, size_t capacity);
} f2shim_api;

/* The implementation over libfreenect2; the table lives as long as the program. */
const f2shim_api *f2shim_libfreenect2(void);

#ifdef __cplusplus
}
#endif

#endif
