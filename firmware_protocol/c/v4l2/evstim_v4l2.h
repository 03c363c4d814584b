/* SPDX-License-Identifier: MIT OR GPL-2.0 */
/*
 * A sensor on Linux's camera interface that is fed by a program: `evstim v4l2` and no other hardware.
 *
 * The program opens /dev/evstim-v4l2 and describes the sensor; then there are /dev/mediaN with two entities, /dev/videoN
 * for the words and /dev/v4l-subdevN for the controls, until the program closes the file. All integers below are those
 * of the machine.
 *
 * Messages that the program writes, one with each write(2):
 *
 *     0   u32  kind    1 sensor, 2 words, 3 answer
 *     4   ...          struct evstim_sensor; the words; s32, 0 or -errno of the request that was read
 *
 * Words fill the next buffer that the client has queued: write returns the octets that it took, EAGAIN with no buffer.
 *
 * Requests that it reads, one with each read(2): struct evstim_request. The client's system call returns when the request
 * is answered, or with EIO after 20 seconds, as a transfer on I2C would fail.
 *
 * poll(2): POLLIN a request waits, POLLOUT a buffer waits.
 */
#ifndef EVSTIM_V4L2_H
#define EVSTIM_V4L2_H

#include <linux/platform_device.h>
#include <linux/uio.h>
#include <media/media-device.h>
#include <media/v4l2-ctrls.h>
#include <media/v4l2-device.h>
#include <media/v4l2-subdev.h>
#include <media/videobuf2-v4l2.h>

#define MOST_FORMATS 4
#define MOST_CONTROLS 16
#define MOST_VALUES 74
#define LEAST_BUFFER 4096
#define MOST_BUFFER (16 << 20)
#define ANSWER_TIMEOUT (20 * HZ)

enum { MESSAGE_SENSOR = 1, MESSAGE_WORDS, MESSAGE_ANSWER };
enum { REQUEST_STREAM = 1, REQUEST_FORMAT, REQUEST_CONTROL, REQUEST_CROP };

/* A control: type and limits as in struct v4l2_ctrl_config; an array of u32 where `values` is above 1. */
struct evstim_control {
	__s64 least, most, step, initial;
	__u32 id, type, values, reserved;
	char name[32];
};

/* The sensor: pixel formats and their codes on the bus, the first one is set; `has_crop`: a selection is possible. */
struct evstim_sensor {
	char name[32], serial[32];
	__u32 width, height, buffer_bytes, has_crop, formats, controls;
	__u32 fourcc[MOST_FORMATS], bus_code[MOST_FORMATS];
	struct evstim_control control[MOST_CONTROLS];
};

/* A request: `id` a control's, or the index of a format; values: on or off, the control's, or x, y, width, height. */
struct evstim_request {
	__u32 kind, id;
	__s64 value;
	__u32 values[MOST_VALUES];
};

struct camera {
	struct v4l2_device v4l2;
	struct media_device media;
	struct video_device video;
	struct v4l2_subdev subdev;
	struct media_pad video_pad, subdev_pad;
	struct v4l2_ctrl_handler controls;
	struct vb2_queue queue;
	struct mutex lock;		/* of the queue and the video device */
	struct evstim_sensor sensor;
	struct v4l2_rect crop;
	__u32 format, sequence;

	spinlock_t buffers_lock;
	struct list_head buffers;
	struct mutex writing;		/* of the buffer that words are written to, and of `streams` */
	bool streams;

	struct mutex one_request;	/* of all below: one client's call waits for an answer, the others for it */
	spinlock_t request_lock;
	struct evstim_request request;
	bool waits, taken, gone;
	int result;
	struct completion answered;
	wait_queue_head_t changed;
};

/* camera.c: all devices of a sensor, from its description until they are removed. */
struct camera *add_camera(struct platform_device *parent, const struct evstim_sensor *sensor);
void remove_camera(struct camera *camera);

/*
 * video.c: the video device, and words for the next buffer, or -EAGAIN. As with a DMA engine, which holds the buffer
 * after the one that it fills, the newest waits for one more: so VIDIOC_QBUF never returns a buffer already filled.
 */
int init_video(struct camera *camera);
bool has_buffer(struct camera *camera);
ssize_t write_words(struct camera *camera, struct iov_iter *from);

/* sensor.c: the subdevice and its controls; the place of a name among others, 0 if it is not there. */
int init_sensor(struct camera *camera);
__u32 place_of(const __u32 *names, __u32 count, __u32 name);

/* program.c: a request to the program, until its answer; the answer, from the program or because it is gone. */
int send_request(struct camera *camera, const struct evstim_request *request);
void take_answer(struct camera *camera, int result);

#endif
