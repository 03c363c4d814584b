"""Model of an event camera on a narrow link: settings, telecommands, queues, messages and housekeeping."""
