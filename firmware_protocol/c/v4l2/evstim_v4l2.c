// SPDX-License-Identifier: MIT OR GPL-2.0
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
#include <linux/fs.h>
#include <linux/miscdevice.h>
#include <linux/module.h>
#include <linux/platform_device.h>
#include <linux/poll.h>
#include <linux/slab.h>
#include <linux/uaccess.h>
#include <linux/uio.h>
#include <media/media-device.h>
#include <media/v4l2-ctrls.h>
#include <media/v4l2-device.h>
#include <media/v4l2-event.h>
#include <media/v4l2-ioctl.h>
#include <media/v4l2-subdev.h>
#include <media/videobuf2-vmalloc.h>

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

struct buffer {
	struct vb2_v4l2_buffer vb;
	struct list_head entry;
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
	bool streams;

	struct mutex one_request;	/* of all below: one client's call waits for an answer, the others for it */
	spinlock_t request_lock;
	struct evstim_request request;
	bool waits, taken, gone;
	int result;
	struct completion answered;
	wait_queue_head_t changed;
};

static struct platform_device *platform;
static DEFINE_MUTEX(opening);
static bool is_open;

/* ------------------------------------------------------------------ requests to the program */

static int request(struct camera *camera, const struct evstim_request *what)
{
	int result;
	long left;

	mutex_lock(&camera->one_request);
	spin_lock(&camera->request_lock);
	if (camera->gone) {
		spin_unlock(&camera->request_lock);
		mutex_unlock(&camera->one_request);
		return -ENODEV;
	}
	camera->request = *what;
	camera->waits = true;
	camera->taken = false;
	reinit_completion(&camera->answered);
	spin_unlock(&camera->request_lock);
	wake_up_interruptible(&camera->changed);

	left = wait_for_completion_timeout(&camera->answered, ANSWER_TIMEOUT);
	spin_lock(&camera->request_lock);
	result = left ? camera->result : -EIO;
	camera->waits = camera->taken = false;
	spin_unlock(&camera->request_lock);
	mutex_unlock(&camera->one_request);
	return result;
}

static void answer(struct camera *camera, int result)
{
	spin_lock(&camera->request_lock);
	if (camera->taken) {
		camera->taken = camera->waits = false;
		camera->result = result;
		complete(&camera->answered);
	}
	spin_unlock(&camera->request_lock);
}

/* ------------------------------------------------------------------ buffers of words */

static struct camera *camera_of(struct vb2_queue *queue)
{
	return vb2_get_drv_priv(queue);
}

static int queue_setup(struct vb2_queue *queue, unsigned int *buffers, unsigned int *planes, unsigned int sizes[],
		       struct device *alloc_devs[])
{
	if (*planes)
		return sizes[0] < camera_of(queue)->sensor.buffer_bytes ? -EINVAL : 0;
	*planes = 1;
	sizes[0] = camera_of(queue)->sensor.buffer_bytes;
	return 0;
}

static int buf_prepare(struct vb2_buffer *vb)
{
	return vb2_plane_size(vb, 0) < camera_of(vb->vb2_queue)->sensor.buffer_bytes ? -EINVAL : 0;
}

static void buf_queue(struct vb2_buffer *vb)
{
	struct camera *camera = camera_of(vb->vb2_queue);
	struct buffer *buffer = container_of(to_vb2_v4l2_buffer(vb), struct buffer, vb);

	spin_lock(&camera->buffers_lock);
	list_add_tail(&buffer->entry, &camera->buffers);
	spin_unlock(&camera->buffers_lock);
	wake_up_interruptible(&camera->changed);
}

static struct buffer *take_buffer(struct camera *camera)
{
	struct buffer *buffer;

	spin_lock(&camera->buffers_lock);
	buffer = list_first_entry_or_null(&camera->buffers, struct buffer, entry);
	if (buffer)
		list_del(&buffer->entry);
	spin_unlock(&camera->buffers_lock);
	return buffer;
}

static void return_buffers(struct camera *camera, enum vb2_buffer_state state)
{
	struct buffer *buffer;

	while ((buffer = take_buffer(camera)))
		vb2_buffer_done(&buffer->vb.vb2_buf, state);
}

static int start_streaming(struct vb2_queue *queue, unsigned int count)
{
	struct camera *camera = camera_of(queue);
	const struct evstim_request format = { .kind = REQUEST_FORMAT, .id = camera->format };
	const struct evstim_request start = { .kind = REQUEST_STREAM, .value = 1 };
	int result = request(camera, &format);

	camera->sequence = 0;
	WRITE_ONCE(camera->streams, true); /* before the answer: the first words may follow it at once */
	if (!result)
		result = request(camera, &start);
	if (result) {
		WRITE_ONCE(camera->streams, false);
		return_buffers(camera, VB2_BUF_STATE_QUEUED);
	}
	return result;
}

static void stop_streaming(struct vb2_queue *queue)
{
	struct camera *camera = camera_of(queue);
	const struct evstim_request stop = { .kind = REQUEST_STREAM, .value = 0 };

	request(camera, &stop);
	WRITE_ONCE(camera->streams, false);
	return_buffers(camera, VB2_BUF_STATE_ERROR);
}

static const struct vb2_ops queue_ops = {
	.queue_setup = queue_setup,
	.buf_prepare = buf_prepare,
	.buf_queue = buf_queue,
	.start_streaming = start_streaming,
	.stop_streaming = stop_streaming,
	.wait_prepare = vb2_ops_wait_prepare,
	.wait_finish = vb2_ops_wait_finish,
};

/* ------------------------------------------------------------------ the video device */

static int querycap(struct file *file, void *priv, struct v4l2_capability *cap)
{
	struct camera *camera = video_drvdata(file);

	strscpy(cap->driver, "evstim", sizeof(cap->driver));
	strscpy(cap->card, camera->sensor.serial, sizeof(cap->card));
	snprintf(cap->bus_info, sizeof(cap->bus_info), "platform:%s", dev_name(&platform->dev));
	return 0;
}

static int enum_fmt(struct file *file, void *priv, struct v4l2_fmtdesc *fmt)
{
	struct camera *camera = video_drvdata(file);
	__u32 place, number = fmt->index;

	for (place = 0; place < camera->sensor.formats; place++) {
		if (fmt->mbus_code && fmt->mbus_code != camera->sensor.bus_code[place])
			continue;
		if (number--)
			continue;
		fmt->pixelformat = camera->sensor.fourcc[place];
		fmt->flags = V4L2_FMT_FLAG_COMPRESSED; /* variable octets in a buffer */
		snprintf(fmt->description, sizeof(fmt->description), "events %.4s", (char *)&fmt->pixelformat);
		return 0;
	}
	return -EINVAL;
}

static void fill_format(const struct camera *camera, __u32 place, struct v4l2_pix_format *pix)
{
	*pix = (struct v4l2_pix_format){
		.width = camera->sensor.width,
		.height = camera->sensor.height,
		.pixelformat = camera->sensor.fourcc[place],
		.field = V4L2_FIELD_NONE,
		.sizeimage = camera->sensor.buffer_bytes,
		.colorspace = V4L2_COLORSPACE_RAW,
	};
}

static __u32 place_of(const __u32 *names, __u32 count, __u32 name)
{
	__u32 place;

	for (place = 0; place < count; place++)
		if (names[place] == name)
			return place;
	return 0; /* V4L2 sets a format that the device has in place of one that it has not */
}

static int g_fmt(struct file *file, void *priv, struct v4l2_format *format)
{
	struct camera *camera = video_drvdata(file);

	fill_format(camera, camera->format, &format->fmt.pix);
	return 0;
}

static int try_fmt(struct file *file, void *priv, struct v4l2_format *format)
{
	struct camera *camera = video_drvdata(file);

	fill_format(camera, place_of(camera->sensor.fourcc, camera->sensor.formats, format->fmt.pix.pixelformat), &format->fmt.pix);
	return 0;
}

static int s_fmt(struct file *file, void *priv, struct v4l2_format *format)
{
	struct camera *camera = video_drvdata(file);

	if (vb2_is_busy(&camera->queue))
		return -EBUSY;
	try_fmt(file, priv, format);
	camera->format = place_of(camera->sensor.fourcc, camera->sensor.formats, format->fmt.pix.pixelformat);
	return 0;
}

static int enum_input(struct file *file, void *priv, struct v4l2_input *input)
{
	if (input->index)
		return -EINVAL;
	input->type = V4L2_INPUT_TYPE_CAMERA;
	strscpy(input->name, "sensor", sizeof(input->name));
	return 0;
}

static int g_input(struct file *file, void *priv, unsigned int *number)
{
	*number = 0;
	return 0;
}

static int s_input(struct file *file, void *priv, unsigned int number)
{
	return number ? -EINVAL : 0;
}

static const struct v4l2_ioctl_ops ioctl_ops = {
	.vidioc_querycap = querycap,
	.vidioc_enum_fmt_vid_cap = enum_fmt,
	.vidioc_g_fmt_vid_cap = g_fmt,
	.vidioc_try_fmt_vid_cap = try_fmt,
	.vidioc_s_fmt_vid_cap = s_fmt,
	.vidioc_enum_input = enum_input,
	.vidioc_g_input = g_input,
	.vidioc_s_input = s_input,
	.vidioc_reqbufs = vb2_ioctl_reqbufs,
	.vidioc_create_bufs = vb2_ioctl_create_bufs,
	.vidioc_querybuf = vb2_ioctl_querybuf,
	.vidioc_qbuf = vb2_ioctl_qbuf,
	.vidioc_dqbuf = vb2_ioctl_dqbuf,
	.vidioc_expbuf = vb2_ioctl_expbuf,
	.vidioc_streamon = vb2_ioctl_streamon,
	.vidioc_streamoff = vb2_ioctl_streamoff,
};

static const struct v4l2_file_operations video_fops = {
	.owner = THIS_MODULE,
	.open = v4l2_fh_open,
	.release = vb2_fop_release,
	.mmap = vb2_fop_mmap,
	.poll = vb2_fop_poll,
	.unlocked_ioctl = video_ioctl2,
};

/* ------------------------------------------------------------------ the sensor's subdevice */

static int s_ctrl(struct v4l2_ctrl *ctrl)
{
	struct camera *camera = container_of(ctrl->handler, struct camera, controls);
	struct evstim_request change = { .kind = REQUEST_CONTROL, .id = ctrl->id };

	if (ctrl->type == V4L2_CTRL_TYPE_INTEGER64)
		change.value = *ctrl->p_new.p_s64;
	else if (ctrl->type == V4L2_CTRL_TYPE_U32)
		memcpy(change.values, ctrl->p_new.p_u32, ctrl->elems * sizeof(__u32));
	else
		change.value = ctrl->val;
	return request(camera, &change);
}

static const struct v4l2_ctrl_ops ctrl_ops = { .s_ctrl = s_ctrl };

static struct camera *camera_of_subdev(struct v4l2_subdev *subdev)
{
	return container_of(subdev, struct camera, subdev);
}

static int enum_mbus_code(struct v4l2_subdev *subdev, struct v4l2_subdev_state *state,
			  struct v4l2_subdev_mbus_code_enum *code)
{
	struct camera *camera = camera_of_subdev(subdev);

	if (code->index >= camera->sensor.formats)
		return -EINVAL;
	code->code = camera->sensor.bus_code[code->index];
	return 0;
}

static int enum_frame_size(struct v4l2_subdev *subdev, struct v4l2_subdev_state *state,
			   struct v4l2_subdev_frame_size_enum *size)
{
	struct camera *camera = camera_of_subdev(subdev);

	if (size->index)
		return -EINVAL;
	size->min_width = size->max_width = camera->sensor.width;
	size->min_height = size->max_height = camera->sensor.height;
	return 0;
}

static void fill_bus_format(const struct camera *camera, __u32 place, struct v4l2_mbus_framefmt *format)
{
	*format = (struct v4l2_mbus_framefmt){
		.width = camera->sensor.width,
		.height = camera->sensor.height,
		.code = camera->sensor.bus_code[place],
		.field = V4L2_FIELD_NONE,
		.colorspace = V4L2_COLORSPACE_RAW,
	};
}

static int get_fmt(struct v4l2_subdev *subdev, struct v4l2_subdev_state *state, struct v4l2_subdev_format *format)
{
	struct camera *camera = camera_of_subdev(subdev);

	fill_bus_format(camera, camera->format, &format->format);
	return 0;
}

static int set_fmt(struct v4l2_subdev *subdev, struct v4l2_subdev_state *state, struct v4l2_subdev_format *format)
{
	struct camera *camera = camera_of_subdev(subdev);
	__u32 place = place_of(camera->sensor.bus_code, camera->sensor.formats, format->format.code);

	if (format->which == V4L2_SUBDEV_FORMAT_ACTIVE) {
		if (vb2_is_busy(&camera->queue))
			return -EBUSY;
		camera->format = place;
	}
	fill_bus_format(camera, place, &format->format);
	return 0;
}

static int get_selection(struct v4l2_subdev *subdev, struct v4l2_subdev_state *state,
			 struct v4l2_subdev_selection *selection)
{
	struct camera *camera = camera_of_subdev(subdev);

	if (!camera->sensor.has_crop)
		return -ENOIOCTLCMD;
	switch (selection->target) {
	case V4L2_SEL_TGT_CROP:
		selection->r = camera->crop;
		return 0;
	case V4L2_SEL_TGT_NATIVE_SIZE:
	case V4L2_SEL_TGT_CROP_DEFAULT:
	case V4L2_SEL_TGT_CROP_BOUNDS:
		selection->r = (struct v4l2_rect){ 0, 0, camera->sensor.width, camera->sensor.height };
		return 0;
	default:
		return -EINVAL;
	}
}

static int set_selection(struct v4l2_subdev *subdev, struct v4l2_subdev_state *state,
			 struct v4l2_subdev_selection *selection)
{
	struct camera *camera = camera_of_subdev(subdev);
	struct evstim_request crop = { .kind = REQUEST_CROP };
	const int width = camera->sensor.width, height = camera->sensor.height;
	struct v4l2_rect *rect = &selection->r;
	int result = 0;

	if (!camera->sensor.has_crop)
		return -ENOIOCTLCMD;
	if (selection->target != V4L2_SEL_TGT_CROP)
		return -EINVAL;
	rect->left = clamp(rect->left, 0, width - 1);
	rect->top = clamp(rect->top, 0, height - 1);
	rect->width = clamp_t(__u32, rect->width, 1, width - rect->left);
	rect->height = clamp_t(__u32, rect->height, 1, height - rect->top);
	if (selection->which == V4L2_SUBDEV_FORMAT_ACTIVE) {
		crop.values[0] = rect->left;
		crop.values[1] = rect->top;
		crop.values[2] = rect->width;
		crop.values[3] = rect->height;
		result = request(camera, &crop);
		if (!result)
			camera->crop = *rect;
	}
	return result;
}

static const struct v4l2_subdev_pad_ops pad_ops = {
	.enum_mbus_code = enum_mbus_code,
	.enum_frame_size = enum_frame_size,
	.get_fmt = get_fmt,
	.set_fmt = set_fmt,
	.get_selection = get_selection,
	.set_selection = set_selection,
};

static const struct v4l2_subdev_core_ops core_ops = {
	.subscribe_event = v4l2_ctrl_subdev_subscribe_event,
	.unsubscribe_event = v4l2_event_subdev_unsubscribe,
};

static const struct v4l2_subdev_ops subdev_ops = { .core = &core_ops, .pad = &pad_ops };

/* ------------------------------------------------------------------ from the description to the devices */

static void release_camera(struct v4l2_device *v4l2)
{
	struct camera *camera = container_of(v4l2, struct camera, v4l2);

	media_device_cleanup(&camera->media);
	media_entity_cleanup(&camera->video.entity);
	media_entity_cleanup(&camera->subdev.entity);
	v4l2_ctrl_handler_free(&camera->controls);
	kfree(camera);
}

static int add_controls(struct camera *camera)
{
	__u32 place;

	v4l2_ctrl_handler_init(&camera->controls, camera->sensor.controls);
	for (place = 0; place < camera->sensor.controls; place++) {
		struct evstim_control *control = &camera->sensor.control[place];
		struct v4l2_ctrl_config config = {
			.ops = &ctrl_ops,
			.id = control->id,
			.name = control->name,
			.type = control->type,
			.min = control->least,
			.max = control->most,
			.step = control->step,
			.def = control->initial,
		};

		control->name[sizeof(control->name) - 1] = 0;
		if (control->type == V4L2_CTRL_TYPE_U32)
			config.dims[0] = clamp_t(__u32, control->values, 1, MOST_VALUES);
		v4l2_ctrl_new_custom(&camera->controls, &config, NULL);
	}
	return camera->controls.error;
}

static bool is_valid(const struct evstim_sensor *sensor)
{
	__u32 place;

	for (place = 0; place < min_t(__u32, sensor->controls, MOST_CONTROLS); place++) {
		switch (sensor->control[place].type) {
		case V4L2_CTRL_TYPE_INTEGER:
		case V4L2_CTRL_TYPE_BOOLEAN:
		case V4L2_CTRL_TYPE_BUTTON:
		case V4L2_CTRL_TYPE_INTEGER64:
		case V4L2_CTRL_TYPE_U32:
			break;
		default:
			return false;
		}
	}
	return sensor->formats >= 1 && sensor->formats <= MOST_FORMATS && sensor->controls <= MOST_CONTROLS &&
	       sensor->width >= 1 && sensor->width <= 16384 && sensor->height >= 1 && sensor->height <= 16384 &&
	       sensor->buffer_bytes >= LEAST_BUFFER && sensor->buffer_bytes <= MOST_BUFFER;
}

static int init_video(struct camera *camera)
{
	struct video_device *video = &camera->video;
	struct vb2_queue *queue = &camera->queue;
	int result;

	queue->type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
	queue->io_modes = VB2_MMAP | VB2_USERPTR | VB2_DMABUF;
	queue->drv_priv = camera;
	queue->buf_struct_size = sizeof(struct buffer);
	queue->ops = &queue_ops;
	queue->mem_ops = &vb2_vmalloc_memops;
	queue->timestamp_flags = V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
	queue->lock = &camera->lock;
	queue->min_buffers_needed = 1;
	result = vb2_queue_init(queue);
	if (result)
		return result;
	strscpy(video->name, "evstim words", sizeof(video->name));
	video->v4l2_dev = &camera->v4l2;
	video->fops = &video_fops;
	video->ioctl_ops = &ioctl_ops;
	video->queue = queue;
	video->lock = &camera->lock;
	video->release = video_device_release_empty;
	video->device_caps = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
	video_set_drvdata(video, camera);
	camera->video_pad.flags = MEDIA_PAD_FL_SINK;
	return media_entity_pads_init(&video->entity, 1, &camera->video_pad);
}

static int init_subdev(struct camera *camera)
{
	struct v4l2_subdev *subdev = &camera->subdev;

	v4l2_subdev_init(subdev, &subdev_ops);
	subdev->owner = THIS_MODULE;
	subdev->flags = V4L2_SUBDEV_FL_HAS_DEVNODE | V4L2_SUBDEV_FL_HAS_EVENTS;
	subdev->ctrl_handler = &camera->controls;
	subdev->entity.function = MEDIA_ENT_F_CAM_SENSOR;
	strscpy(subdev->name, camera->sensor.name, sizeof(subdev->name));
	camera->subdev_pad.flags = MEDIA_PAD_FL_SOURCE;
	return media_entity_pads_init(&subdev->entity, 1, &camera->subdev_pad);
}

static void remove_camera(struct camera *camera)
{
	spin_lock(&camera->request_lock);
	camera->gone = true;
	camera->taken = true; /* a client that waits for an answer gets one */
	spin_unlock(&camera->request_lock);
	answer(camera, -ENODEV);
	media_device_unregister(&camera->media);
	vb2_video_unregister_device(&camera->video);
	v4l2_device_unregister(&camera->v4l2);
	v4l2_device_put(&camera->v4l2); /* release_camera follows when the last client has closed its file */
}

static struct camera *add_camera(const struct evstim_sensor *sensor)
{
	struct camera *camera;
	int result;

	if (!is_valid(sensor))
		return ERR_PTR(-EINVAL);
	camera = kzalloc(sizeof(*camera), GFP_KERNEL);
	if (!camera)
		return ERR_PTR(-ENOMEM);
	camera->sensor = *sensor;
	camera->sensor.name[sizeof(camera->sensor.name) - 1] = 0;
	camera->sensor.serial[sizeof(camera->sensor.serial) - 1] = 0;
	camera->crop = (struct v4l2_rect){ 0, 0, sensor->width, sensor->height };
	mutex_init(&camera->lock);
	mutex_init(&camera->one_request);
	spin_lock_init(&camera->buffers_lock);
	spin_lock_init(&camera->request_lock);
	INIT_LIST_HEAD(&camera->buffers);
	init_completion(&camera->answered);
	init_waitqueue_head(&camera->changed);

	strscpy(camera->media.model, "evstim", sizeof(camera->media.model));
	strscpy(camera->media.serial, camera->sensor.serial, sizeof(camera->media.serial));
	camera->media.dev = &platform->dev;
	media_device_init(&camera->media);
	camera->v4l2.mdev = &camera->media;
	strscpy(camera->v4l2.name, "evstim", sizeof(camera->v4l2.name));
	result = v4l2_device_register(&platform->dev, &camera->v4l2);
	if (result) {
		media_device_cleanup(&camera->media);
		kfree(camera);
		return ERR_PTR(result);
	}
	camera->v4l2.release = release_camera;

	result = add_controls(camera);
	if (!result)
		result = init_video(camera);
	if (!result)
		result = init_subdev(camera);
	if (!result)
		result = v4l2_device_register_subdev(&camera->v4l2, &camera->subdev);
	if (!result)
		result = video_register_device(&camera->video, VFL_TYPE_VIDEO, -1);
	if (!result)
		result = v4l2_device_register_subdev_nodes(&camera->v4l2);
	if (!result)
		result = media_create_pad_link(&camera->subdev.entity, 0, &camera->video.entity, 0,
					       MEDIA_LNK_FL_ENABLED | MEDIA_LNK_FL_IMMUTABLE);
	if (!result)
		result = media_device_register(&camera->media);
	if (result) {
		remove_camera(camera);
		return ERR_PTR(result);
	}
	return camera;
}

/* ------------------------------------------------------------------ the program's file */

static int program_open(struct inode *inode, struct file *file)
{
	int result = 0;

	mutex_lock(&opening);
	if (is_open)
		result = -EBUSY;
	is_open = true;
	mutex_unlock(&opening);
	file->private_data = NULL;
	return result;
}

static int program_release(struct inode *inode, struct file *file)
{
	if (file->private_data)
		remove_camera(file->private_data);
	mutex_lock(&opening);
	is_open = false;
	mutex_unlock(&opening);
	return 0;
}

static ssize_t write_sensor(struct file *file, struct iov_iter *from)
{
	struct evstim_sensor *sensor;
	struct camera *camera;

	if (iov_iter_count(from) != sizeof(*sensor))
		return -EINVAL;
	sensor = kmalloc(sizeof(*sensor), GFP_KERNEL);
	if (!sensor)
		return -ENOMEM;
	if (!copy_from_iter_full(sensor, sizeof(*sensor), from)) {
		kfree(sensor);
		return -EFAULT;
	}
	mutex_lock(&opening);
	camera = file->private_data ? ERR_PTR(-EBUSY) : add_camera(sensor);
	if (!IS_ERR(camera))
		file->private_data = camera;
	mutex_unlock(&opening);
	kfree(sensor);
	return IS_ERR(camera) ? PTR_ERR(camera) : sizeof(*sensor);
}

static ssize_t write_words(struct camera *camera, struct iov_iter *from)
{
	struct buffer *buffer;
	size_t octets = min_t(size_t, iov_iter_count(from), camera->sensor.buffer_bytes);

	if (!READ_ONCE(camera->streams))
		return octets; /* nobody is there to read them */
	buffer = take_buffer(camera);
	if (!buffer)
		return -EAGAIN;
	if (!copy_from_iter_full(vb2_plane_vaddr(&buffer->vb.vb2_buf, 0), octets, from)) {
		vb2_buffer_done(&buffer->vb.vb2_buf, VB2_BUF_STATE_ERROR);
		return -EFAULT;
	}
	vb2_set_plane_payload(&buffer->vb.vb2_buf, 0, octets);
	buffer->vb.vb2_buf.timestamp = ktime_get_ns();
	buffer->vb.sequence = camera->sequence++;
	buffer->vb.field = V4L2_FIELD_NONE;
	vb2_buffer_done(&buffer->vb.vb2_buf, VB2_BUF_STATE_DONE);
	return octets;
}

static ssize_t program_write(struct kiocb *call, struct iov_iter *from)
{
	struct file *file = call->ki_filp;
	struct camera *camera = file->private_data;
	ssize_t taken;
	__u32 kind;
	__s32 result;

	if (!copy_from_iter_full(&kind, sizeof(kind), from))
		return -EINVAL;
	if (kind == MESSAGE_SENSOR)
		taken = write_sensor(file, from);
	else if (!camera)
		return -EINVAL;
	else if (kind == MESSAGE_WORDS && iov_iter_count(from))
		taken = write_words(camera, from);
	else if (kind == MESSAGE_ANSWER && iov_iter_count(from) == sizeof(result)) {
		if (!copy_from_iter_full(&result, sizeof(result), from))
			return -EFAULT;
		answer(camera, clamp(result, -MAX_ERRNO, 0));
		taken = sizeof(result);
	} else
		return -EINVAL;
	return taken < 0 ? taken : taken + (ssize_t)sizeof(kind);
}

static ssize_t program_read(struct file *file, char __user *to, size_t octets, loff_t *place)
{
	struct camera *camera = file->private_data;
	struct evstim_request taken;

	if (!camera || octets != sizeof(taken))
		return -EINVAL;
	spin_lock(&camera->request_lock);
	if (!camera->waits || camera->taken) {
		spin_unlock(&camera->request_lock);
		return -EAGAIN;
	}
	camera->taken = true;
	taken = camera->request;
	spin_unlock(&camera->request_lock);
	return copy_to_user(to, &taken, sizeof(taken)) ? -EFAULT : sizeof(taken);
}

static __poll_t program_poll(struct file *file, poll_table *table)
{
	struct camera *camera = file->private_data;
	__poll_t ready = 0;

	if (!camera)
		return EPOLLERR;
	poll_wait(file, &camera->changed, table);
	spin_lock(&camera->request_lock);
	if (camera->waits && !camera->taken)
		ready |= EPOLLIN;
	spin_unlock(&camera->request_lock);
	spin_lock(&camera->buffers_lock);
	if (!list_empty(&camera->buffers))
		ready |= EPOLLOUT;
	spin_unlock(&camera->buffers_lock);
	return ready;
}

static const struct file_operations program_fops = {
	.owner = THIS_MODULE,
	.open = program_open,
	.release = program_release,
	.read = program_read,
	.write_iter = program_write,
	.poll = program_poll,
	.llseek = noop_llseek,
};

static struct miscdevice program = {
	.minor = MISC_DYNAMIC_MINOR,
	.name = "evstim-v4l2",
	.fops = &program_fops,
	.mode = 0600,
};

/* The parent of the devices: V4L2 keeps its driver's module loaded while one is open. */
static struct platform_driver driver = { .driver = { .name = "evstim-v4l2" } };

static int __init probe(struct platform_device *device)
{
	return 0;
}

static int __init evstim_init(void)
{
	int result;

	platform = platform_create_bundle(&driver, probe, NULL, 0, NULL, 0);
	if (IS_ERR(platform))
		return PTR_ERR(platform);
	result = misc_register(&program);
	if (result) {
		platform_device_unregister(platform);
		platform_driver_unregister(&driver);
	}
	return result;
}

static void __exit evstim_exit(void)
{
	misc_deregister(&program);
	platform_device_unregister(platform);
	platform_driver_unregister(&driver);
}

module_init(evstim_init);
module_exit(evstim_exit);
MODULE_DESCRIPTION("Event camera on V4L2 that evstim feeds");
MODULE_LICENSE("Dual MIT/GPL");
