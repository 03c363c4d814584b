// SPDX-License-Identifier: MIT OR GPL-2.0
/* The devices of a sensor, from its description on, and their end. */
#include <linux/slab.h>
#include "evstim_v4l2.h"

static void release_camera(struct v4l2_device *v4l2)
{
	struct camera *camera = container_of(v4l2, struct camera, v4l2);

	media_device_cleanup(&camera->media);
	media_entity_cleanup(&camera->video.entity);
	media_entity_cleanup(&camera->subdev.entity);
	v4l2_ctrl_handler_free(&camera->controls);
	kfree(camera);
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

void remove_camera(struct camera *camera)
{
	spin_lock(&camera->request_lock);
	camera->gone = true;
	camera->taken = true; /* a client that waits for an answer gets one */
	spin_unlock(&camera->request_lock);
	take_answer(camera, -ENODEV);
	media_device_unregister(&camera->media);
	vb2_video_unregister_device(&camera->video);
	v4l2_device_unregister(&camera->v4l2);
	v4l2_device_put(&camera->v4l2); /* release_camera follows when the last client has closed its file */
}

struct camera *add_camera(struct platform_device *parent, const struct evstim_sensor *sensor)
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
	mutex_init(&camera->writing);
	spin_lock_init(&camera->buffers_lock);
	spin_lock_init(&camera->request_lock);
	INIT_LIST_HEAD(&camera->buffers);
	init_completion(&camera->answered);
	init_waitqueue_head(&camera->changed);

	strscpy(camera->media.model, "evstim", sizeof(camera->media.model));
	strscpy(camera->media.serial, camera->sensor.serial, sizeof(camera->media.serial));
	camera->media.dev = &parent->dev;
	media_device_init(&camera->media);
	camera->v4l2.mdev = &camera->media;
	strscpy(camera->v4l2.name, "evstim", sizeof(camera->v4l2.name));
	result = v4l2_device_register(&parent->dev, &camera->v4l2);
	if (result) {
		media_device_cleanup(&camera->media);
		kfree(camera);
		return ERR_PTR(result);
	}
	camera->v4l2.release = release_camera;

	result = init_video(camera);
	if (!result)
		result = init_sensor(camera);
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
