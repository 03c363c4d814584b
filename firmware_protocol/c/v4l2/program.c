// SPDX-License-Identifier: MIT OR GPL-2.0
/* The program's file: its messages, the requests to it, and the module. */
#include <linux/fs.h>
#include <linux/miscdevice.h>
#include <linux/module.h>
#include <linux/poll.h>
#include <linux/slab.h>
#include <linux/uaccess.h>
#include "evstim_v4l2.h"

static struct platform_device *platform;
static DEFINE_MUTEX(opening);
static bool is_open;

int send_request(struct camera *camera, const struct evstim_request *request)
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
	camera->request = *request;
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

void take_answer(struct camera *camera, int result)
{
	spin_lock(&camera->request_lock);
	if (camera->taken) {
		camera->taken = camera->waits = false;
		camera->result = result;
		complete(&camera->answered);
	}
	spin_unlock(&camera->request_lock);
}

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
	camera = file->private_data ? ERR_PTR(-EBUSY) : add_camera(platform, sensor);
	if (!IS_ERR(camera))
		file->private_data = camera;
	mutex_unlock(&opening);
	kfree(sensor);
	return IS_ERR(camera) ? PTR_ERR(camera) : sizeof(*sensor);
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
		take_answer(camera, clamp(result, -MAX_ERRNO, 0));
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
	if (has_buffer(camera))
		ready |= EPOLLOUT;
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
