"""Behavioural models of the parts on the board, for the unmodified STM32F405 image under Unicorn.

Written from the reference manuals, each model naming its sections: RM0090 (STM32F405 reference manual), PM0214
(Cortex-M4 programming manual), the ADIS16405 data sheet. Where firmware breaks a rule of a part, the model notes it in
`Machine.violations`, so that a test can demand that there is none."""
