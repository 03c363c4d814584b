// SPDX-License-Identifier: MIT OR GPL-2.0
/* The sensor's subdevice: formats, the selection, and controls, which the program writes to the sensor. */
#include <media/v4l2-event.h>
#include "evstim_v4l2.h"

__u32 place_of(const __u32 *names, __u32 count, __u32 name)
{
	__u32 place;

	for (place = 0; place < count; place++)
		if (names[place] == name)
			return place;
	return 0; /* V4L2 sets a format that the device has in place of one that it has not */
}

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
	return send_request(camera, &change);
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
		result = send_request(camera, &crop);
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

int init_sensor(struct camera *camera)
{
	struct v4l2_subdev *subdev = &camera->subdev;
	int result = add_controls(camera);

	if (result)
		return result;
	v4l2_subdev_init(subdev, &subdev_ops);
	subdev->owner = THIS_MODULE;
	subdev->flags = V4L2_SUBDEV_FL_HAS_DEVNODE | V4L2_SUBDEV_FL_HAS_EVENTS;
	subdev->ctrl_handler = &camera->controls;
	subdev->entity.function = MEDIA_ENT_F_CAM_SENSOR;
	strscpy(subdev->name, camera->sensor.name, sizeof(subdev->name));
	camera->subdev_pad.flags = MEDIA_PAD_FL_SOURCE;
	return media_entity_pads_init(&subdev->entity, 1, &camera->subdev_pad);
}
