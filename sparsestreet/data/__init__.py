"""Driving logs: what they are, where they come from, and in which order training sees them.

log          DrivingLog, what the rest of the package sees of any data set; its split
clock        when frames were recorded: normalized time, seconds and stamps
window       which frames and cameras of a log are read
rig          the cameras of a rig, and whether their lenses are simulated or taken out
undistortion what a pinhole would have recorded instead of a lens
posed_images images with poses and lenses and nothing else: cameras and instants from names
poses        rigid transforms: checked, and re-centered
tracks       annotated objects: checked, and cut to the frames that are read
scene_folder a log on disk whose images and points are decoded when they are asked for
extent       whether all of a log lies within one scene
notes        what a run does without the parts that a log lacks
fingerprint  a hash of the files that are read
lazy         frames and sweeps that are read when they are indexed, and the cache of what was read
reader       LogReader, what every data set offers: check and read
problems     what is wrong with a log on disk, all at once, with remedies
check        what `sparsestreet data check` prints
images       pixels and masks from files
given_masks  masks that somebody made for a data set
ego          rows of images that show the recording car
numbers      numbers from text files
json_tree    values of JSON files that know where they stand
ply          points from .ply files
lidar        colors that points take from images, depth that pixels take from points
formats      data sets as they are published, to be named where they must be converted first
nuscenes     reader of nuScenes as it is published: tables of JSON, images, sweeps
drivestudio  reader of DriveStudio's processed layout
argoverse2   reader of Argoverse 2's sensor data set
pandaset     reader of PandaSet
nerfstudio   reader of transforms.json
colmap       reader of sparse models
rig_json     reader of a rig that somebody describes by hand
synthetic    the embedded street: traced, written in that layout, read from there
datamodule   the loaders of training and validation
device       frozen values from one device to another
"""
