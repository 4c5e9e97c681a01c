"""Lead the arm by hand, and it does the same again."""

from armctl import Arm

with Arm() as arm:
    input("Support the arm. Enter: it goes limp, and what you do with it is recorded, until you press Enter again.")
    arm.teach("by-hand", confirm=True)
    input("Hold it still, and press Enter.")
    arm.torque_on()
    input("Let go of it, and press Enter.")
    print(f"{arm.play('by-hand')['mean_error_mm']:.1f} mm off what you did, by the encoders")
