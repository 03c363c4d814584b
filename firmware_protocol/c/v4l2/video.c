// SPDX-License-Identifier: MIT OR GPL-2.0
/* The video device: buffers that the client queues and the program fills. */
#include <linux/version.h>
#include <media/v4l2-ioctl.h>
#include <media/videobuf2-vmalloc.h>
#include "evstim_v4l2.h"

struct buffer {
	struct vb2_v4l2_buffer vb;
	struct list_head entry;
};

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

bool has_buffer(struct camera *camera)
{
	bool has;

	spin_lock(&camera->buffers_lock);
	has = !list_empty(&camera->buffers) && !list_is_singular(&camera->buffers);
	spin_unlock(&camera->buffers_lock);
	return has;
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

static void set_streams(struct camera *camera, bool streams)
{
	mutex_lock(&camera->writing); /* no buffer is on its way when this returns */
	camera->streams = streams;
	mutex_unlock(&camera->writing);
}

static int start_streaming(struct vb2_queue *queue, unsigned int count)
{
	struct camera *camera = camera_of(queue);
	const struct evstim_request format = { .kind = REQUEST_FORMAT, .id = camera->format };
	const struct evstim_request start = { .kind = REQUEST_STREAM, .value = 1 };
	int result = send_request(camera, &format);

	camera->sequence = 0;
	set_streams(camera, true); /* before the answer: the first words may follow it at once */
	if (!result)
		result = send_request(camera, &start);
	if (result) {
		set_streams(camera, false);
		return_buffers(camera, VB2_BUF_STATE_QUEUED);
	}
	return result;
}

static void stop_streaming(struct vb2_queue *queue)
{
	struct camera *camera = camera_of(queue);
	const struct evstim_request stop = { .kind = REQUEST_STREAM, .value = 0 };

	send_request(camera, &stop);
	set_streams(camera, false);
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

static ssize_t write_to_buffer(struct camera *camera, struct iov_iter *from)
{
	struct buffer *buffer;
	size_t octets = min_t(size_t, iov_iter_count(from), camera->sensor.buffer_bytes);

	if (!camera->streams)
		return octets; /* nobody is there to read them */
	if (!has_buffer(camera))
		return -EAGAIN;
	buffer = take_buffer(camera);
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

ssize_t write_words(struct camera *camera, struct iov_iter *from)
{
	ssize_t taken;

	mutex_lock(&camera->writing);
	taken = write_to_buffer(camera, from);
	mutex_unlock(&camera->writing);
	return taken;
}

static int querycap(struct file *file, void *priv, struct v4l2_capability *cap)
{
	struct camera *camera = video_drvdata(file);

	strscpy(cap->driver, "evstim", sizeof(cap->driver));
	strscpy(cap->card, camera->sensor.serial, sizeof(cap->card));
	snprintf(cap->bus_info, sizeof(cap->bus_info), "platform:%s", dev_name(camera->media.dev));
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

int init_video(struct camera *camera)
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
#if LINUX_VERSION_CODE >= KERNEL_VERSION(6, 8, 0)
	queue->min_queued_buffers = 2;
#else
	queue->min_buffers_needed = 2;
#endif
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
