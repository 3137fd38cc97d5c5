"""A render server: simulators ask a trained street for pictures, as ``SensorsimService`` says it."""
