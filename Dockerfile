# armctl with its viewer, and the system libraries that draw pictures and films without a screen.
#
#   docker build -t armctl .
#   docker run --rm armctl                                                   moves the bundled arm to the green target
#   docker run --rm -it -p 8080:8080 -e ARMCTL_TOKEN=a-secret armctl armctl view robot_arm_3dof --host 0.0.0.0
#                                    then open http://localhost:8080/?token=a-secret
FROM python:3.12-slim
RUN apt-get update -qq \
 && apt-get install -y -qq --no-install-recommends libosmesa6 libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri make g++ \
 && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=egl
RUN useradd --create-home user
WORKDIR /home/user/armctl
COPY --chown=user . .
RUN pip install --no-cache-dir '.[view]'
USER user
CMD ["armctl", "reach", "robot_arm_3dof"]
